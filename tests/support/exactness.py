"""What exact means across machines (docs/log/exactness.md).

On one machine a handoff is the same to the last bit, whatever came before; and the same as recorded, where
the kernels are those of the recording. Elsewhere the last bit differs and contacts make more of it: then
recorded states are compared in millimetres.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Mapping

from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.replay.handoff import Handoff
from lerobot_roborecover.scenario import Scenario
from lerobot_roborecover.utils.determinism import CORE_TYPE, core_type_in_use

PINNED = core_type_in_use() == CORE_TYPE
"""This machine rounds as the one that recorded."""
ROUNDING_MM = {"metaworld": 1e-4, "libero": 0.01, "lerobot_pusht": 0.0, "fake": 0.0}
"""By platform, where it does not; the bound that decides a handoff is 2 mm."""

_PROGRAM = """
import json, sys
from lerobot_roborecover import load_scenarios
from lerobot_roborecover.replay.handoff import hand_off
from lerobot_roborecover.platforms import make_simulator
name, ids = sys.argv[1], json.loads(sys.argv[2])
scenarios = {s.id: s for s in load_scenarios(name)}
simulator = make_simulator(scenarios[ids[0]].platform, obs_type="state")
print(json.dumps({i: hand_off(simulator, scenarios[i]).state_sha256 for i in ids}))
"""


def as_recorded(scenario: Scenario, handoff: Handoff) -> bool:
    """Whether the handoff is the recorded one, up to another processor's rounding."""
    if PINNED:
        return handoff.problem is None and handoff.identical
    error_mm = max(handoff.eef_error_mm, handoff.object_error_mm)
    return handoff.problem is None and error_mm <= ROUNDING_MM[scenario.platform]


def row_as_recorded(row: TrialRow) -> bool:
    """Whether a trial's handoff was."""
    if PINNED:
        return row.handoff_identical is True
    return max(row.handoff_eef_error_mm, row.handoff_object_error_mm) <= ROUNDING_MM[row.platform]


def states_in_a_fresh_process(name: str, ids: list[str]) -> Mapping[str, str]:
    """Hashes of the states at the handoff of a shipped set's scenarios, made in this order."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _PROGRAM, name, json.dumps(ids)],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])
