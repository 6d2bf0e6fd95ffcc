#!/bin/sh
# SBOM (CycloneDX 1.6) and licence list of what a role installs; a licence that would bind the product fails.
# usage: sbom.sh PYTHON_OF_THE_ROLE TOOLS_BIN OUT_DIR
set -eu
python=$1
tools=$2
out=$3
mkdir -p "$out"
"$tools/cyclonedx-py" environment --pyproject pyproject.toml --output-reproducible --of JSON -o "$out/sbom.cdx.json" "$python"
"$tools/pip-licenses" --python "$python" --from=mixed --ignore-packages tactile-insertion --order=name --format=markdown \
  --output-file "$out/licences.md" --partial-match \
  --fail-on='GNU General Public;GNU Affero;GPL-2;GPL-3;AGPL;UNKNOWN;Proprietary'
printf '%s components in %s\n' "$("$python" -c 'import json, sys; print(len(json.load(open(sys.argv[1]))["components"]))' "$out/sbom.cdx.json")" "$out/sbom.cdx.json"
printf '%s licences in %s, none that binds the product\n' "$(grep -c '^| [^ ]' "$out/licences.md")" "$out/licences.md"
