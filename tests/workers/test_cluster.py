"""Jobs on a Ray cluster of two nodes: the same results as here, and none lost with a node."""

from __future__ import annotations

import os
import signal
import time

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import SimulatorError
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.workers.backend import Backend, WorkerStartup
from lerobot_roborecover.workers.jobs import Done, JobPool
from tests.support.ray_cluster import two_nodes
from tests.workers.test_jobs import squared, work

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.nightly]

RAY = Backend("ray")


@pytest.fixture(scope="module")
def cluster():
    with two_nodes() as nodes:
        yield nodes


def takes_its_node_along(what):
    """Ends the process that looks after this one, which is what a lost node looks like; or works a while."""
    if what == "lost":
        os.kill(os.getppid(), signal.SIGKILL)
    time.sleep(0.2)
    return what


def sleepy(number):
    time.sleep(0.5)
    return number**2


def test_the_same_results_as_here_and_the_same_refusals(cluster):
    cluster.complete()
    with JobPool("fake", workplace=RAY) as pool:
        assert list(pool.map_ordered(squared, range(7))) == [n**2 for n in range(7)]
        assert dict(pool.run(squared, iter(range(5)), lambda n: (n, 2))) == {n: 2 * n**2 for n in range(5)}
        assert list(pool.map_ordered(squared, [])) == []
        with pytest.raises(ScenarioError, match="the limit is 2"):
            pool.call(work, "refuses")
        with pytest.raises(SimulatorError, match="a worker process died"):
            pool.call(work, "dies")
        mine = pool.call(work, "simulator")[1]
    with JobPool("fake") as pool:
        assert pool.call(work, "simulator")[1] == mine
    with JobPool(workers=1, fresh=True, workplace=RAY) as pool:
        found = dict(pool.run(work, ["a", "b"]))
    assert found["a"][0] != found["b"][0]
    with JobPool(limit_s=0.5, workers=1, fresh=True, workplace=RAY) as pool:
        ((_, outcome),) = pool.outcomes(work, ["hangs"], lambda what: (what,))
    assert outcome.kind == "hung"


def test_an_abandoned_iterator_leaves_nothing_at_work(cluster):
    cluster.complete()
    with JobPool("fake", workers=2, workplace=RAY) as pool:
        for item, _ in pool.run(work, ["a", "hangs", "b"]):
            assert item in "ab"
            break
        assert pool.call(work, "c")[1] == "c"


def test_what_takes_its_node_along_is_tried_three_times_and_costs_no_other(cluster):
    cluster.complete()
    with JobPool(workers=3, workplace=RAY) as pool:
        items = ["a", "lost", "b", "c"]
        found = dict(pool.outcomes(takes_its_node_along, items, lambda what: (what,)))
    assert {k: v.value for k, v in found.items() if isinstance(v, Done)} == {k: k for k in "abc"}
    assert found["lost"].kind == "lost"
    assert found["lost"].message.startswith("lost 3 times, last: ")


def test_a_lost_node_costs_nothing_but_time(cluster):
    cluster.complete()
    found, lost = [], cluster.lost
    with JobPool(workplace=RAY) as pool:
        for value in pool.map_ordered(sleepy, range(20)):
            found.append(value)
            if len(found) == 3:
                cluster.lose_a_node()
    assert found == [n**2 for n in range(20)]
    assert cluster.lost == lost + 1


def other_versions(platform):
    return {"lerobot_env_roborecover": "0.0.1", "numpy": "1.0"}


def no_device(turn):
    raise OptionError(f"simulator {turn} has nothing to draw on")


def test_a_cluster_that_cannot_do_the_work_is_refused(cluster, monkeypatch):
    from lerobot_roborecover.workers import cluster as module
    from lerobot_roborecover.workers.messages import SlotConfig
    from lerobot_roborecover.workers.slots import SlotPool

    cluster.complete()
    with (
        JobPool("fake", workers=9, workplace=RAY) as pool,
        pytest.raises(OptionError, match=r"9 simulators need 9 CPUs; .* has 4\. Use --num-workers=4"),
    ):
        pool.call(work, "a")
    pool = SlotPool(SlotConfig("fake"), workers=True, timeout_s=60)
    RAY.allocate_workers(pool, 1, 1, WorkerStartup(no_device))
    with pytest.raises(OptionError, match=r"node [0-9.]+ .*cannot begin: simulator 0 has nothing to draw on"):
        pool.ask("fingerprint")
    pool.close()
    monkeypatch.setattr(module, "decisive_versions", other_versions)
    with (
        JobPool("fake", workers=1, workplace=RAY) as pool,
        pytest.raises(module.ClusterError, match=r"has lerobot_env_roborecover .* \(here 0\.0\.1\), numpy"),
    ):
        pool.call(work, "a")
