"""Functions in worker processes: results, refusals, deaths, and which process runs what."""

from __future__ import annotations

import os
import sys
import time
from types import SimpleNamespace

import pytest

from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.scenario import Reset, ScenarioError, Task
from lerobot_roborecover.workers import jobs
from lerobot_roborecover.workers.jobs import Done, JobError, JobPool, simulator_of_worker
from lerobot_roborecover.workers.messages import SlotConfig, SlotFailure
from tests.support.processes import alive_after

TASK = Task("fake", "toy", "push-left", "push", 60)


class OwnError(Exception):
    """Needs two values to be made, so that it cannot be unpickled."""

    def __init__(self, one, two):
        super().__init__(f"{one} and {two}")


def work(what):
    """Whatever a job may do."""
    if what == "refuses":
        raise ScenarioError("field x: 3; the limit is 2")
    if what == "breaks":
        raise OwnError(1, 2)
    if what == "dies":
        os._exit(3)
    if what == "hangs":
        time.sleep(3600)
    if what == "simulator":
        simulator = simulator_of_worker()
        simulator.reset(TASK, Reset(seed=1))
        return os.getpid(), simulator.state_sha256()
    return os.getpid(), what


def squared(number, by=1):
    time.sleep(0.05 * (number % 3))
    return number**2 * by


def heavy():
    return {"lerobot", "torch"} & set(sys.modules)


@pytest.mark.slow
def test_results_come_in_the_order_of_the_items_and_each_once():
    with JobPool("fake", workers=3) as pool:
        assert list(pool.map_ordered(squared, range(7))) == [n**2 for n in range(7)]
        assert dict(pool.run(squared, iter(range(5)), lambda n: (n, 2))) == {n: 2 * n**2 for n in range(5)}
        assert list(pool.map_ordered(squared, [])) == []
        assert pool.call(heavy) == set()


@pytest.mark.slow
def test_what_goes_wrong_is_that_jobs_own_affair():
    wanted = ["a", "refuses", "breaks", "dies", "b"]
    with JobPool("fake", workers=1) as pool:
        found = dict(pool.outcomes(work, wanted, lambda what: (what,)))
        assert found["refuses"] == JobError(found["refuses"].error)
        assert isinstance(found["refuses"].error, ScenarioError)
        assert found["refuses"].words == "field x: 3; the limit is 2"
        assert found["breaks"].words == "RuntimeError: OwnError: 1 and 2"
        assert isinstance(found["dies"], SlotFailure)
        assert "exit status 3" in found["dies"].message
        assert isinstance(found["a"], Done)
        assert found["a"].value[0] != found["b"].value[0], "the dead process was replaced"
        with pytest.raises(ScenarioError, match="the limit is 2"):
            pool.call(work, "refuses")
        with pytest.raises(SimulatorError, match="a worker process died"):
            pool.call(work, "dies")


@pytest.mark.slow
def test_one_process_and_one_simulator_from_job_to_job():
    with JobPool("fake", workers=1) as pool:
        first, second = (pool.call(work, "simulator") for _ in range(2))
    assert first == second
    with JobPool("fake", {"obs_type": "smell"}) as pool, pytest.raises(SimulatorError, match="obs_type"):
        pool.call(work, "simulator")


@pytest.mark.slow
def test_a_fresh_process_for_each_and_a_limit_for_it():
    with JobPool(workers=1, fresh=True) as pool:
        found = dict(pool.run(work, ["a", "b"]))
    assert found["a"][0] != found["b"][0]
    with JobPool(limit_s=0.5, fresh=True) as pool:
        ((_, outcome),) = pool.outcomes(work, ["hangs"], lambda what: (what,))
    assert outcome.kind == "hung"


def test_an_abandoned_iterator_leaves_nothing_at_work():
    with JobPool("fake", workers=2) as pool:
        for item, (pid, _) in pool.run(work, ["a", "hangs", "b"]):
            assert item in "ab"
            pids = {str(pid)}
            break
        assert pool.call(work, "c")[1] == "c"
    assert not alive_after(pids)


def test_a_function_that_no_worker_can_import_is_refused():
    with JobPool("fake") as pool, pytest.raises(ValueError, match="no function of a module"):
        pool.call(lambda: 1)


def test_a_process_keeps_few_simulators(monkeypatch):
    closed = []

    def make(_platform: str, n: int) -> SimpleNamespace:
        return SimpleNamespace(close=lambda: closed.append(n))

    monkeypatch.setattr(jobs, "make_simulator", make)
    monkeypatch.setattr(jobs, "_server", None)
    jobs.JobServer(SlotConfig("fake", {"n": 0}, server=jobs.SERVER))
    asked: list[dict[str, int] | None] = [None, {"n": 1}, {"n": 2}, {"n": 0}, {"n": 3}]
    made = [simulator_of_worker(options) for options in asked]
    assert made[3] is made[0]
    assert closed == [0]
    jobs.drop_simulators_of_worker()
    assert sorted(closed) == [0, 1, 2, 3]
