#!/usr/bin/env bash
# Builds sdist and wheel and checks them: scripts/package.sh [OUT] [--try]. With --try the wheel is installed into an
# empty environment, and the demo runs from there, outside the clone, on a few scenarios.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
out=dist try=
for argument in "$@"; do
    if [[ "$argument" == --try ]]; then try=yes; else out="$argument"; fi
done
uv="$(scripts/uv.sh)"
mkdir -p .tools && echo '*' >.tools/.gitignore
env=.tools/package
"$uv" venv --quiet --allow-existing --python 3.12 "$env"
"$env/bin/python" scripts/extra.py package >"$env/wanted.txt"
"$uv" pip install --quiet --python "$env/bin/python" -c constraints.txt -r "$env/wanted.txt"
rm -f "$out"/lerobot_env_roborecover-*
# What an earlier build left would be packed again, files that are gone among it.
rm -rf build lerobot_env_roborecover.egg-info/SOURCES.txt
"$env/bin/python" -m build --outdir "$out" . >"$env/build.log" 2>&1 || {
    tail -n 20 "$env/build.log" >&2
    exit 1
}
"$env/bin/twine" check --strict "$out"/lerobot_env_roborecover-*
"$env/bin/python" scripts/check_package.py "$out"
[[ -n "$try" ]] || exit 0

there="$(mktemp -d)"
trap 'rm -rf "$there"' EXIT
wheel="$(realpath "$out"/lerobot_env_roborecover-*.whl)" versions="$PWD/constraints.txt"
[[ "$uv" == /* ]] || uv="$PWD/$uv"
"$uv" venv --quiet --python 3.12 "$there/env"
"$uv" pip install --quiet --python "$there/env/bin/python" -c "$versions" "$wheel"
cd "$there"
unset PYTHONPATH
export PATH="$there/env/bin:$PATH" MUJOCO_GL="${MUJOCO_GL:-egl}"
roborecover --version
python -c 'import lerobot_roborecover as r; assert r.__file__.startswith("'"$there"'"), r.__file__'
roborecover demo --limit 4 --out demo
test -s demo/report.html
echo "the wheel works: $(basename "$wheel")"
