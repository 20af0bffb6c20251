"""`kill -9` of the main process at a random moment: nothing finished is lost, repeated or doubled, and no
process is left behind; under LeRobot's loop, and under the engine of `roborecover eval`."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lerobot_roborecover.datasets import write_scenarios
from tests.evaluation.test_local_engine import run_engine
from tests.support.factories import fake_dataset, fake_scenario
from tests.support.loop import evaluate, outcomes
from tests.support.processes import PATIENCE_S, alive_after, children

TRIALS = 3
_BEGIN = """
import sys
sys.path.insert(0, {root!r})
from pathlib import Path
"""
WAYS = {
    "loop": """
from tests.support.loop import evaluate
evaluate(Path({dataset!r}), Path({log!r}), trials={trials}, batch={width}, workers=True)
""",
    "engine": """
from tests.evaluation.test_local_engine import run_engine
run_engine(Path({dataset!r}), Path({log!r}), slots={width}, step_s=0.002)
""",
}


def _start(way: str, dataset: Path, log: Path, width: int) -> subprocess.Popen:
    """A run in a process of its own; `width` trials at a time."""
    code = (_BEGIN + WAYS[way]).format(
        root=str(Path(__file__).parents[2]), dataset=str(dataset), log=str(log), trials=TRIALS, width=width
    )
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL)


def _lines(log: Path) -> int:
    return log.read_bytes().count(b"\n") if log.exists() else 0


STORM = pytest.mark.nightly


@pytest.mark.slow
@pytest.mark.parametrize(
    ("way", "count", "least"),
    [
        ("engine", 3, 1), pytest.param("loop", 4, 1, marks=STORM),
        pytest.param("loop", 12, 3, marks=STORM), pytest.param("engine", 8, 3, marks=STORM),
    ],
)  # fmt: skip
def test_kills_lose_nothing(tmp_path, way, count, least):
    dataset = fake_dataset(tmp_path / "set", 8)
    reference = outcomes(evaluate(dataset, tmp_path / "reference.jsonl", trials=TRIALS, batch=1))
    log, rng = tmp_path / "log.jsonl", random.Random(0)
    kills, unfinished, simulators = 0, 0, set()
    while kills < count:
        before = log.read_bytes() if log.exists() else b""
        # A lock that a dead run had left would show here: the next run would not begin.
        process = _start(way, dataset, log, width=rng.choice([1, 3]))
        # Let it finish a few trials, then kill at a random moment, so that kills land everywhere: in the
        # start-up, in a handoff, in a step, in a write. When all trials are done, begin a new log and go on.
        want, deadline = _lines(log) + rng.randint(0, 2), time.monotonic() + PATIENCE_S
        while process.poll() is None and _lines(log) < want and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.02))
        simulators |= children(process)
        process.send_signal(signal.SIGKILL)
        status = process.wait()
        assert status in (0, -signal.SIGKILL), f"a run ended by itself, with status {status}"
        kills += 1
        after = log.read_bytes() if log.exists() else b""
        complete = before[: before.rfind(b"\n") + 1]
        assert after.startswith(complete), "a finished trial was lost or rewritten"
        if _lines(log) == 8 * TRIALS:
            log.rename(tmp_path / f"full-{kills}.jsonl")
        elif kills % 7 == 0:
            # A line cut off in the middle of a write, which the kill alone seldom hits.
            with open(log, "ab") as file:
                file.write(b'{"schema": 1, "scenario_id": "fake-')
        unfinished += 0 < _lines(log) < 8 * TRIALS
    assert unfinished >= least, "kills must land in the middle of a run"
    assert not alive_after(simulators), "a simulator outlived its run"
    if way == "engine":
        assert outcomes(run_engine(dataset, log)) == reference
    else:
        assert outcomes(evaluate(dataset, log, trials=TRIALS, batch=3)) == reference
    for file in [log, *tmp_path.glob("full-*.jsonl")]:
        records = [json.loads(line) for line in file.read_text().splitlines()]
        keys = [(r["scenario_id"], r["trial"]) for r in records]
        assert len(keys) == len(set(keys)) == 8 * TRIALS


@pytest.mark.slow
@pytest.mark.parametrize("way", ["engine", pytest.param("loop", marks=STORM)])
def test_a_simulator_stuck_in_native_code_ends_with_its_parent(tmp_path, way):
    """It never looks at its socket, so the kernel has to end it."""
    stuck = fake_scenario(1, name="hangs", suite="faults")
    dataset = write_scenarios(tmp_path / "set", [stuck])
    process = _start(way, dataset, tmp_path / "log.jsonl", width=2)
    deadline = time.monotonic() + PATIENCE_S
    while len(_sleeping(process)) < 2 and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    simulators = children(process)
    assert len(simulators) == 2
    process.kill()
    process.wait()
    assert not alive_after(simulators)


def _sleeping(process: subprocess.Popen) -> set[str]:
    """Children that are in a sleep, which is how the fake simulator hangs."""

    def inside(pid: str) -> str:
        try:
            return Path(f"/proc/{pid}/wchan").read_text()
        except OSError:
            return ""

    return {pid for pid in children(process) if "nanosleep" in inside(pid)}
