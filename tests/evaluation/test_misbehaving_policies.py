"""A policy that misbehaves costs its own trials: what it gives is never repaired, and never stops the run."""

from __future__ import annotations

import subprocess
import sys
import textwrap
import threading
from dataclasses import replace

import numpy as np
import pytest

from lerobot_roborecover.evaluation.launch import EngineConfig, RunResult, open_engine
from lerobot_roborecover.evaluation.options import RecoveryOptions
from lerobot_roborecover.evaluation.session import SimulatorSpec, create_session
from lerobot_roborecover.evaluation.work_items import units_of
from lerobot_roborecover.logs.trial_log import read_trial_log
from lerobot_roborecover.policies.interventions.control_columns import SIGNATURE
from lerobot_roborecover.policies.metadata import PolicyMetadata
from lerobot_roborecover.policies.watchdog import CallTimeoutError, PolicyThread
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.workers.messages import SlotConfig
from tests.evaluation.test_local_engine import PushHost
from tests.support.factories import fake_dataset
from tests.support.loop import evaluate, push_policy
from tests.support.misbehaving import BAD_ROWS
from tests.support.processes import PATIENCE_S

COUNT, TRIALS = 2, 2


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    return fake_dataset(tmp_path_factory.mktemp("fake") / "set", COUNT)


class BadHost(PushHost):
    """Gives what `spoil` makes of a list of (1, 2) chunks."""

    def __init__(self, spoil):
        super().__init__()
        self._spoil = spoil

    def act(self, observations, instructions, histories):
        return self._spoil(super().act(observations, instructions, histories))


class BlockingHost(PushHost):
    """Blocks from its n-th inference on."""

    def __init__(self, good: int):
        super().__init__()
        self.release, self._good = threading.Event(), good

    def act(self, observations, instructions, histories):
        answers = super().act(observations, instructions, histories)
        if len(self.batches) > self._good:
            self.release.wait()
        return answers


def run_engine(dataset, log, host, stop=lambda: False, **options):
    """What the run came to, and the log's rows."""
    scenarios, run = create_session(
        RecoveryOptions(scenarios=str(dataset), trial_log=str(log), **options),
        SimulatorSpec(SlotConfig("fake"), {}, None),
        workers=True,
        facts=PolicyMetadata(policy="push", n_episodes=TRIALS, execution_horizon=1),
    )
    run.protocol = replace(run.protocol, run_seed=1000)
    run.pool.acquire()
    try:
        units = units_of(list(scenarios), TRIALS)
        # Without the check of the first trials, which would stop the run before the other rows.
        engine = open_engine(run, units, lambda: host, EngineConfig(slots=COUNT))
        result = RunResult(engine.run(units, stop), engine.reruns, engine.unrun)
    finally:
        run.pool.release()
    return result, read_trial_log(log)


def signed(columns):
    """Spoils chunks with columns that look like a directive."""
    return lambda chunks: [
        np.concatenate([c, np.array([[SIGNATURE, *columns]], "f4")], axis=1) for c in chunks
    ]


BAD_CHUNKS = {
    "too few": (lambda chunks: chunks[:-1], "rows of actions for"),
    "too many": (lambda chunks: [*chunks, chunks[0]], "rows of actions for"),
    "nothing": (lambda chunks: [None] * len(chunks), "gave a NoneType"),
    "lists": (lambda chunks: [c.tolist() for c in chunks], "gave a list"),
    "an empty chunk": (lambda chunks: [c[:0] for c in chunks], "(0, 2); expected (n, 2)"),
    "three axes": (lambda chunks: [c[None] for c in chunks], "(1, 1, 2); expected (n, 2)"),
    "one action": (lambda chunks: [c[0] for c in chunks], "(2,); expected (n, 2)"),
    "an unreadable directive": (signed([np.nan, 0, -1, 0]), "(7,)"),
    "an unknown controller": (signed([0, 77, -1, 0]), "(7,)"),
} | {
    name: (lambda chunks, spoil=spoil: [spoil(c) for c in chunks], words)
    for name, (spoil, words) in BAD_ROWS.items()
    if words[0] != "r" and name != "no column axis"
}


ASKED = [(bad, False) for bad in BAD_CHUNKS] + [(bad, True) for bad in ("nothing", "one action", "complex")]
FEW = [
    ("too few", False),
    ("nothing", False),
    ("one action", False),
    ("an unknown controller", False),
    ("nothing", True),
]
"""What the default run takes of it."""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bad", "realtime"),
    [pytest.param(*asked, marks=() if asked in FEW else pytest.mark.nightly) for asked in ASKED],
)
def test_a_bad_answer_becomes_policy_errors_in_the_engine(dataset, tmp_path, bad, realtime):
    spoil, words = BAD_CHUNKS[bad]
    options = {"realtime": True, "latency_s": 0.1} if realtime else {}
    engine, rows = run_engine(dataset, tmp_path / "log.jsonl", BadHost(spoil), **options)
    assert {(r.outcome, r.steps) for r in rows} == {("policy_error", 0)}
    assert all(words in r.reason for r in rows), rows[0].reason
    assert len(rows) == COUNT * TRIALS
    assert not engine.unrun


@pytest.mark.parametrize("bad", BAD_ROWS)
def test_a_bad_answer_becomes_policy_errors_in_lerobots_loop(dataset, tmp_path, bad):
    spoil, words = BAD_ROWS[bad]
    rows = evaluate(
        dataset, tmp_path / "log.jsonl", trials=TRIALS, batch=TRIALS,
        policy=lambda observation: spoil(push_policy(observation)),
    )  # fmt: skip
    assert {(r.outcome, r.steps) for r in rows} == {("policy_error", 0)}
    assert all(words in r.reason for r in rows), rows[0].reason
    assert len(rows) == COUNT * TRIALS


@pytest.mark.slow
@pytest.mark.parametrize(
    "dtype", ["f2", "i8", *(pytest.param(d, marks=pytest.mark.nightly) for d in ("f4", "f8", "i4", "u1"))]
)
def test_real_numbers_of_any_size_are_executed(dataset, tmp_path, dtype):
    host = BadHost(lambda chunks: [np.clip(c, 0, 1).astype(dtype) for c in chunks])
    _, rows = run_engine(dataset, tmp_path / "log.jsonl", host)
    assert {r.outcome for r in rows} <= {"success", "horizon"}


@pytest.mark.nightly
@pytest.mark.slow
def test_a_policy_that_blocks_ends_its_trials_and_the_run(dataset, tmp_path):
    host = BlockingHost(good=5)
    engine, rows = run_engine(dataset, tmp_path / "log.jsonl", host, policy_watchdog_s=5.0)
    host.release.set()
    asked = host.batches[-1]
    assert [r.outcome for r in rows] == ["policy_error"] * asked
    assert all("did not answer within 5 s" in r.reason and "policy_watchdog_s" in r.reason for r in rows)
    done = {(r.scenario_id, r.trial) for r in rows}
    assert len(done) + len(engine.unrun) == COUNT * TRIALS
    assert not done & set(engine.unrun)
    with pytest.raises(ScenarioError, match=r"could not be run.*did not answer"):
        engine.check_all_run()
    engine, rows = run_engine(dataset, tmp_path / "log.jsonl", PushHost())
    assert len(rows) == COUNT * TRIALS, "the same command goes on"
    assert sum(r.outcome == "policy_error" for r in rows) == asked


@pytest.mark.nightly
def test_a_run_that_is_to_stop_does_not_wait_for_a_policy_that_blocks(dataset, tmp_path):
    host = BlockingHost(good=5)
    engine, rows = run_engine(
        dataset, tmp_path / "log.jsonl", host, stop=lambda: len(host.batches) > 5, policy_watchdog_s=0.0
    )
    host.release.set()
    assert rows == []
    assert not engine.unrun


def test_a_thread_gives_back_what_its_calls_return_and_raise():
    thread, release = PolicyThread(), threading.Event()
    assert thread.call(lambda: threading.current_thread().daemon)
    for error in (TimeoutError("its own"), SystemExit(3), KeyError("x")):
        with pytest.raises(type(error)) as caught:
            thread.call(lambda error=error: (_ for _ in ()).throw(error))
        assert caught.value is error
    with pytest.raises(CallTimeoutError):
        thread.call(release.wait, limit_s=0.1)
    release.set()
    thread.close()


HUNG_COMMAND = """
    import ctypes, sys, threading
    from concurrent.futures import ThreadPoolExecutor
    from lerobot_roborecover.cli.config_command import ConfigCommand
    from lerobot_roborecover.cli.main import main
    from lerobot_roborecover.policies import watchdog

    watchdog._LOCK_GRACE_S = 1.0

    def wait_for_another_thread():
        ThreadPoolExecutor(1).submit(threading.Event().wait).result()

    def hold_pythons_lock():
        ctypes.PyDLL(None).pause()

    def run(self, argv):
        thread = watchdog.PolicyThread()
        try:
            thread.call({hang}, limit_s=1.0)
        except watchdog.CallTimeoutError:
            print("written")
        thread.close()
        return 1

    ConfigCommand.pass_through = run
    sys.argv = ["roborecover", "eval"]
    sys.exit(main())
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("hang", "words"), [("wait_for_another_thread", "written"), ("hold_pythons_lock", "Timeout")]
)
def test_a_command_ends_although_its_policy_does_not(hang, words):
    """Python would wait for the executor's thread; and cannot even run where its lock is held."""
    program = textwrap.dedent(HUNG_COMMAND).replace("{hang}", hang)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=PATIENCE_S, check=False
    )
    assert done.returncode == 1
    assert words in done.stdout + done.stderr


HUNG_LOOP = """
    import sys, time
    from tests.support.loop import evaluate, push_policy

    asked = []

    def policy(observation):
        asked.append(observation)
        while len(asked) > 3:
            try:
                time.sleep(1000)
            except KeyboardInterrupt:
                if {stubborn}:
                    continue
                raise
        return push_policy(observation)

    from lerobot_roborecover.policies import watchdog
    watchdog._INTERRUPT_S = 2.0
    evaluate(sys.argv[1], sys.argv[2], trials=2, batch=2, workers=True, policy_watchdog_s=5.0, policy=policy)
"""


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("stubborn", [False, True])
def test_lerobots_loop_ends_where_the_policy_blocks(dataset, tmp_path, stubborn):
    program = textwrap.dedent(HUNG_LOOP).replace("{stubborn}", str(stubborn))
    log = tmp_path / "log.jsonl"
    done = subprocess.run(
        [sys.executable, "-c", program, str(dataset), str(log)],
        capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode != 0
    assert "The evaluation ends here" in done.stderr
    assert str(log) in done.stderr
    rows = read_trial_log(log)
    assert [(r.outcome, r.steps) for r in rows] == [("policy_error", 3)] * 2
    assert all("did not answer within 5 s" in r.reason for r in rows)
