#!/bin/sh
# Pin what each role installs, with hashes and without any index address. torch is left out: see torch.sh.
# UPGRADE= (empty) keeps the versions already pinned and adds only what is new.
set -eu
cd "$(dirname "$0")/.."
pin() {
  out=$1
  shift
  uv pip compile -q ${UPGRADE---upgrade} --python-version 3.11 --universal --generate-hashes --no-emit-index-url \
    --no-annotate --custom-compile-command "make requirements" -o "requirements/$out.txt" pyproject.toml "$@"
}
pin service --extra service
pin robot --extra robot
pin simulation --extra simulation
pin run --extra service --extra robot --extra simulation
pin test --extra service --extra robot --extra simulation --extra training --extra dev \
  --override requirements/no-torch.txt requirements/torch.in --no-emit-package torch
pin ops --extra ops
pin bench --extra bench -c requirements/test.txt
pin docs --extra docs
