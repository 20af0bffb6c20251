#!/usr/bin/env bash
# Sets up what is missing, checks style (ruff), imports (import-linter) and types (ty), then runs the tests on two
# cores. Arguments go to pytest; --quick runs what needs no simulator, no LeRobot and no browser, --nightly the whole
# sweeps, too.
# With --lerobot-main PATH first: what touches LeRobot, or the tests that are named, in .venv-main, against a source
# tree of LeRobot's main. Style and types are left to the default run.
set -euo pipefail
start="$PWD"
cd "$(dirname "${BASH_SOURCE[0]}")/.."
venv=.venv
if [[ "${1:-}" == --lerobot-main ]]; then
    tree="$(cd "$start" && realpath -m -- "${2:-.}")"
    shift $(($# < 2 ? $# : 2))
    scripts/setup.sh --lerobot-main "$tree"
    venv=.venv-main
    (($#)) || set -- -m lerobot
else
    scripts/setup.sh
fi
check_style_and_types() {
    .venv/bin/ruff check --quiet .
    .venv/bin/ruff format --quiet --check . || {
        echo "the format is not ruff's: .venv/bin/ruff format ." >&2
        exit 1
    }
    .venv/bin/lint-imports --no-cache >/dev/null || {
        .venv/bin/lint-imports --no-cache --no-logo >&2 || true
        echo "imports point one way (CONTRIBUTING.md; tool.importlinter in pyproject.toml)" >&2
        exit 1
    }
    .venv/bin/ty check --quiet --python .venv lerobot_roborecover recipes >/dev/null 2>&1 || {
        .venv/bin/ty check --python .venv --output-format concise lerobot_roborecover recipes >&2 || true
        echo "types do not hold: .venv/bin/ty check lerobot_roborecover recipes" >&2
        exit 1
    }
}
[[ "$venv" != .venv ]] || check_style_and_types
# Several hundred processes start: none of them is to compile this package again.
unset PYTHONDONTWRITEBYTECODE
# Simulators are single-threaded; a thread pool each only makes them fight for the cores.
export MUJOCO_GL="${MUJOCO_GL:-egl}" OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
# SAPIEN renders in software where scripts/setup.sh could get a driver for it.
if [[ -z "${VK_ICD_FILENAMES:-}" ]] && icd="$(scripts/vulkan.sh 2>/dev/null)"; then
    export VK_ICD_FILENAMES="$icd"
fi
# A worker that has nothing left takes the other's last tests: neither waits for the other's longest file.
PATH="$PWD/$venv/bin:$PATH" exec "$venv/bin/python" -m pytest -n 2 --dist worksteal "$@"
