#!/usr/bin/env bash
# What can be checked without LeRobot: style, imports, shell scripts and GitHub's workflows. Its tools go to .tools/lint.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
uv="$(scripts/uv.sh)"
env=.tools/lint
mkdir -p .tools && echo '*' >.tools/.gitignore
"$uv" venv --quiet --allow-existing --python 3.12 "$env"
"$env/bin/python" scripts/extra.py lint workflows >"$env/wanted.txt"
"$uv" pip install --quiet --python "$env/bin/python" -c constraints.txt -r "$env/wanted.txt"
export PATH="$PWD/$env/bin:$PATH"
ruff check .
ruff format --check .
lint-imports --no-cache --no-logo
if command -v shellcheck >/dev/null; then
    shellcheck --severity=warning scripts/*.sh .ci/run
fi
actionlint
zizmor --offline --persona auditor .github
