#!/bin/sh
# Pin what each role installs, with hashes and without any index address. torch is left out: see torch.sh.
# UPGRADE= (empty) keeps the versions already pinned and adds only what is new.
set -eu
cd "$(dirname "$0")/.."
pin() {
  out=$1
  shift
  uv pip compile -q ${UPGRADE---upgrade} --python-version 3.11 --universal --generate-hashes --no-emit-index-url \
    --no-annotate --custom-compile-command "make requirements" -o "requirements/$out.txt" "$@"
}
# A role's own requirements: the project's base ones would bring every role's.
extra() {
  python3 - "$@" > "/tmp/$1.in" <<'EOF'
import sys, tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
own = [line for line in project["dependencies"] if not line.startswith(project["name"])]
print("\n".join(own + [line for name in sys.argv[1:] for line in project["optional-dependencies"][name]]))
EOF
  echo "/tmp/$1.in"
}
pin service "$(extra service)"
pin robot "$(extra robot)"
pin simulation "$(extra simulation)"
pin run "$(extra service robot simulation)"
pin test "$(extra service robot simulation training dev)" \
  --override requirements/no-torch.txt requirements/torch.in --no-emit-package torch
pin ops "$(extra ops)"
pin docs "$(extra docs)"
