#!/bin/sh
# Install the CPU build of torch and nothing else: PyPI's own Linux build would bring gigabytes of CUDA packages.
# usage: torch.sh PIP VERSION     TORCH_CPU_INDEX=URL names an index of CPU wheels where pip is not set up with one.
set -eu
pip=$1
version=$2
if [ -n "${TORCH_CPU_INDEX:-}" ]; then
  "$pip" install -q --no-deps --retries 0 --index-url "$TORCH_CPU_INDEX" "torch==$version"
else
  "$pip" install -q --no-deps "torch==$version"
fi
if "$pip" list 2>/dev/null | grep -E '^torch ' | grep -q '+cpu' || [ "$(uname -s)" = Darwin ]; then
  exit 0
fi
"$pip" uninstall -q -y torch
echo "torch $version came as a CUDA build: set TORCH_CPU_INDEX to the address of PyTorch's index of CPU wheels" >&2
exit 2
