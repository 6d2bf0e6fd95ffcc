#!/bin/sh
# Everything a cell without internet needs, in one archive: wheels, code, models, pages, units, an installer, checksums.
# usage: bundle.sh PYTHON OUT_DIR      The wheels fit machines like this one (same Python version, processor, libc).
set -eu
python=$1
out=$2
version=$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml)
tag=$("$python" -c 'import platform, sys; print(f"{sys.platform}-{platform.machine()}-cp{sys.version_info[0]}{sys.version_info[1]}")')
name=tactile-insertion-$version-$tag
work=$out/$name
rm -rf "$work"
mkdir -p "$work/app" "$work/wheels"
git archive HEAD service robot_client simulation reporting tactile_insertion models requirements/run.txt pyproject.toml LICENSE \
  docker/healthcheck.py docker/prometheus docker/grafana README.md CHANGELOG.md CONTRIBUTING.md SECURITY.md docs examples | tar -x -C "$work/app"
# The pins that the installer will read: those of the working tree may be others.
"$python" -m pip download -q --require-hashes --no-deps --only-binary :all: -r "$work/app/requirements/run.txt" -d "$work/wheels"
cp docker/systemd/* docker/install.sh "$work/"
chmod +x "$work/install.sh"
(cd "$work" && find . -type f ! -name SHA256SUMS -print0 | sort -z | xargs -0 sha256sum > SHA256SUMS)
tar -C "$out" --sort=name --owner=0 --group=0 --mtime="$(git log -1 --format=%cI)" -cf "$out/$name.tar" "$name"
(cd "$out" && sha256sum "$name.tar" > "$name.tar.sha256")
printf '%s: %s wheels, %s MB\n' "$out/$name.tar" "$(find "$work/wheels" -name '*.whl' | wc -l)" "$(du -m "$out/$name.tar" | cut -f1)"
