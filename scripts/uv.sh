#!/usr/bin/env bash
# Prints the command of a working uv, installing one for this clone alone where there is none. A private virtual
# environment holds it, because Debian's Python refuses packages of its own users (PEP 668).
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if uv --version >/dev/null 2>&1; then
    command -v uv
    exit 0
fi
if [[ ! -x .tools/bin/uv ]]; then
    for python in python3 /usr/bin/python3; do
        "$python" -c 'import ensurepip' >/dev/null 2>&1 && break
    done
    "$python" -c 'import ensurepip' >/dev/null 2>&1 || scripts/setup.sh --system python3-venv
    echo "uv: installing it in .tools" >&2
    # What else lies in .tools stays: Mesa's driver, the environments of lint, site and package.
    rm -rf .tools/bin .tools/lib .tools/lib64 .tools/include .tools/pyvenv.cfg
    "$python" -m venv .tools
    echo '*' >.tools/.gitignore
    # Held to the hashes that PyPI published. Wheels only: a source distribution would run code to be built.
    .tools/bin/python -m pip install --quiet --retries 5 --only-binary :all: --require-hashes -r scripts/uv_requirements.txt
fi
echo "$PWD/.tools/bin/uv"
