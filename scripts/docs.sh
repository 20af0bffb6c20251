#!/usr/bin/env bash
# Builds the documentation site: scripts/docs.sh [OUT], by default site/; scripts/docs.sh --serve shows it while you
# write. Its tools go to .tools/docs; neither LeRobot nor a simulator is needed.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
uv="$(scripts/uv.sh)"
mkdir -p .tools && echo '*' >.tools/.gitignore
env=.tools/docs
"$uv" venv --quiet --allow-existing --python 3.12 "$env"
"$env/bin/python" scripts/extra.py docs >"$env/wanted.txt"
"$uv" pip install --quiet --python "$env/bin/python" -c constraints.txt -r "$env/wanted.txt"
# Material's authors speak of MkDocs' future in every build.
export NO_MKDOCS_2_WARNING=true
if [[ "${1:-}" == --serve ]]; then
    exec "$env/bin/mkdocs" serve
fi
exec "$env/bin/mkdocs" build --strict --clean --site-dir "${1:-site}"
