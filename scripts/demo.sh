#!/usr/bin/env bash
# Sets up what is missing, then evaluates the shipped policy on the shipped Meta-World scenarios.
# Arguments go to `roborecover demo`; see `scripts/demo.sh --help`.
set -euo pipefail
root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"
"$root/scripts/setup.sh"
unset PYTHONDONTWRITEBYTECODE # every simulator's process would compile this package again
PATH="$root/.venv/bin:$PATH" exec "$root/.venv/bin/roborecover" demo "$@"
