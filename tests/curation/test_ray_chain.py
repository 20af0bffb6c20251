"""`collect`, `screen` and `validate` on a Ray cluster of two nodes, one of which dies in the middle: what
comes out is what comes out here, and everything is written by the command's own process."""

from __future__ import annotations

import json
import sys
from contextlib import contextmanager
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.collect.rollouts import RolloutJournal
from lerobot_roborecover.curation.funnel import read_decisions
from lerobot_roborecover.curation.policy_trials import read_trials
from lerobot_roborecover.datasets import read_scenarios, write_scenarios
from lerobot_roborecover.datasets.frames import last_frames
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.workers.messages import SlotFailure
from tests.curation.test_collect_command import arguments, meaning
from tests.support.factories import fake_scenario, save_policy
from tests.support.processes import PATIENCE_S
from tests.support.ray_cluster import two_nodes

pytestmark = [pytest.mark.ray, pytest.mark.lerobot, pytest.mark.slow, pytest.mark.nightly]

SLOW = "step_s=0.01"
"""Steps that take a while, so that a node can die in the middle; they change no result."""


@pytest.fixture(scope="module")
def cluster():
    with two_nodes() as nodes:
        yield nodes


@pytest.fixture
def run(monkeypatch):
    """The command, in this process."""
    from lerobot_roborecover.cli.main import main

    monkeypatch.setattr(sys, "argv", ["roborecover"])
    return lambda *argv: main([str(word) for word in argv])


@contextmanager
def node_dies(cluster, monkeypatch, during: str = ""):
    """The second node dies while a simulator on it is at its first command.

    Args:
        cluster: of two nodes.
        monkeypatch: of the test.
        during: the command that it dies in; empty takes any.
    """
    import ray

    from lerobot_roborecover.workers.cluster import RaySlot

    cluster.complete()
    before, slots, replies = cluster.lost, [], []
    make, send, receive = RaySlot.__init__, RaySlot.send, RaySlot.receive

    def making(slot, *args):
        make(slot, *args)
        slots.append(slot)

    def sending(slot, command, argument=None):
        if cluster.lost == before:  # all are there, so that the second node's simulators have a share
            ray.wait([each.ready for each in slots], num_returns=len(slots), timeout=PATIENCE_S)
        send(slot, command, argument)
        if cluster.lost == before and during in ("", command) and cluster.second_has(slot._actor):
            cluster.lose_a_node()

    def receiving(slot):
        reply = receive(slot)
        if cluster.lost > before:
            replies.append(reply.kind if isinstance(reply, SlotFailure) else "done")
        return reply

    with monkeypatch.context() as patch:
        patch.setattr(RaySlot, "__init__", making)
        patch.setattr(RaySlot, "send", sending)
        patch.setattr(RaySlot, "receive", receiving)
        yield
    assert cluster.lost == before + 1
    assert set(replies) == {"lost", "done"}


def journal(path: Path) -> list[str]:
    """Its lines, in no order."""
    return sorted(path.read_text().splitlines())


def test_an_experts_rollouts(cluster, run, monkeypatch, tmp_path):
    asked = ["--expert=expert_biased", "--seeds=0-7", "--perturb", "--frames=32", f"--env.{SLOW}"]
    assert run(*arguments(tmp_path / "here", *asked)) == 0
    with node_dies(cluster, monkeypatch):
        assert run(*arguments(tmp_path / "ray", *asked, "--engine=ray", "--slots=0")) == 0
    assert meaning(tmp_path / "ray") == meaning(tmp_path / "here")
    files = [journal(tmp_path / f"{name}.work" / "rollouts.jsonl") for name in ("here", "ray")]
    assert files[0] == files[1]
    assert len(files[0]) == 16, "each rollout ended once"


def test_a_film(cluster, run, monkeypatch, tmp_path):
    """The replays for the pictures are on the cluster, too."""
    asked = ["--expert=expert_biased", "--seeds=0-4", "--frames=32", f"--env.{SLOW}", "--part-size=4"]
    assert run(*arguments(tmp_path / "here", *asked)) == 0
    with node_dies(cluster, monkeypatch, "render"):
        assert run(*arguments(tmp_path / "ray", *asked, "--engine=ray", "--slots=4")) == 0
    assert meaning(tmp_path / "ray") == meaning(tmp_path / "here")


def test_a_policys_rollouts(cluster, run, monkeypatch, tmp_path):
    policy = save_policy(tmp_path / "policy", "diffusion")
    asked = [
        f"--policy.path={policy}",
        "--seeds=0-4",
        "--frames=none",
        "--env.obs_type=state",
        "--device=cpu",
    ]
    asked += [f"--env.{SLOW}", "--perturb", "--min-displacement=1"]
    assert run(*arguments(tmp_path / "here", *asked)) in (0, 1)
    with node_dies(cluster, monkeypatch):
        assert run(*arguments(tmp_path / "ray", *asked, "--engine=ray", "--slots=3")) in (0, 1)
    books = [tmp_path / f"{name}.work" for name in ("here", "ray")]
    here, ray = (journal(book / "rollouts.jsonl") for book in books)
    assert here == ray
    assert len(here) == 20, "each rollout, and its undisturbed twin"
    for record in (books[0] / "rollouts").glob("*.npz"):
        assert record.read_bytes() == (books[1] / "rollouts" / record.name).read_bytes()


@pytest.fixture(scope="module")
def scenarios(tmp_path_factory):
    made = [fake_scenario(i) for i in range(6)]
    simulator = make_simulator("fake", obs_type="pixels_agent_pos")
    frames = [last_frames(simulator, s) for s in made]
    return write_scenarios(tmp_path_factory.mktemp("fake") / "set", made, description="fake", frames=frames)


def screened(root: Path):
    """What a screening made, times left out."""
    rows = {
        folder.name: sorted(
            (t.row.scenario_id, t.row.trial, t.row.outcome, t.row.steps, t.row.actions_sha256, t.row.noise)
            for t in read_trials(folder)
        )
        for folder in Path(f"{root}.trials").iterdir()
    }
    return rows, decided(root), json.loads((root / "meta/roborecover/screening.json").read_text())


def decided(root: Path):
    """Scenarios and decisions."""
    decisions = sorted((d.candidate, d.stage, d.verdict, d.reason, d.detail) for d in read_decisions(root))
    marks = [(s.id, s.sha256(), s.provenance, s.fingerprint.state_sha256) for s in read_scenarios(root)]
    return decisions, marks


@pytest.fixture(scope="module")
def screening(scenarios, tmp_path_factory):
    """Command line but for `--out`, and the result of this machine."""
    from lerobot_roborecover.cli.main import main

    root = tmp_path_factory.mktemp("screened")
    policies = [f"{kind}={save_policy(root / kind, kind)}" for kind in ("act", "diffusion")]
    asked = ["screen", scenarios, "--policy", policies[0], "--policy", policies[1], "--trials", 2]
    asked += ["--keep", "0.0", "1.0", "--device", "cpu", "--max-batch", 1]
    asked = [str(a) for a in [*asked, "--env", SLOW, "--env", "obs_type=state"]]
    assert main([*asked, "--slots=2", "--out", str(root / "here")]) == 0
    return asked, root / "here"


def test_a_screening(cluster, run, monkeypatch, tmp_path, screening):
    asked, here = screening
    with node_dies(cluster, monkeypatch):
        assert run(*asked, "--engine=ray", "--slots=3", "--out", tmp_path / "ray") == 0
    assert screened(tmp_path / "ray") == screened(here)
    assert len(read_scenarios(tmp_path / "ray")) == 6


def test_a_validation(cluster, run, monkeypatch, tmp_path, screening):
    _, here = screening
    asked = ["validate", here, "--trials-folder", f"{here}.trials", "--env", SLOW]
    assert run(*asked, "--workers=2", "--out", tmp_path / "here") == 0
    with node_dies(cluster, monkeypatch):
        assert run(*asked, "--engine=ray", "--out", tmp_path / "ray") == 0
    folders = [Path(f"{tmp_path / name}.replays") for name in ("here", "ray")]
    assert journal(folders[0] / "replays.jsonl") == journal(folders[1] / "replays.jsonl")
    sheets = [sorted((p.name, p.read_bytes()) for p in (f / "sheets").glob("*.png")) for f in folders]
    assert sheets[0] == sheets[1]
    assert len(sheets[0]) == 6
    assert decided(tmp_path / "ray") == decided(tmp_path / "here")
    # What stopped here goes on there: nothing is left to replay.
    assert run(*asked, "--engine=ray", "--out", tmp_path / "here") == 0


@settings(max_examples=3, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    seeds=st.lists(st.integers(0, 500), min_size=1, max_size=3, unique=True),
    slots=st.integers(1, 4),
    perturb=st.booleans(),
)
def test_a_collection_is_the_same_on_both(cluster, run, tmp_path_factory, seeds, slots, perturb):
    root = tmp_path_factory.mktemp("both")
    cluster.complete()
    asked = ["--expert=expert_biased", f"--seeds={','.join(map(str, seeds))}", "--frames=none"]
    asked += ["--perturb"] * perturb
    here = run(*arguments(root / "here", *asked))
    assert run(*arguments(root / "ray", *asked, "--engine=ray", f"--slots={slots}")) == here
    files = [journal(root / f"{name}.work" / "rollouts.jsonl") for name in ("here", "ray")]
    assert files[0] == files[1]
    assert here or meaning(root / "here") == meaning(root / "ray")


def test_what_was_begun_here_goes_on_there(cluster, run, monkeypatch, tmp_path):
    """How fast is no part of what a collection is."""
    cluster.complete()
    asked = ["--expert=expert_biased", "--seeds=0-3", "--frames=none"]
    original, ended = RolloutJournal.add, []

    def stops(book, *args):
        original(book, *args)
        ended.append(args[0].rollout)
        if len(ended) == 3:
            raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(RolloutJournal, "add", stops)
        assert run(*arguments(tmp_path / "one", *asked)) == 130
    assert run(*arguments(tmp_path / "one", *asked, "--engine=ray", "--slots=2")) == 0
    assert len(journal(tmp_path / "one.work" / "rollouts.jsonl")) == 8
    assert run(*arguments(tmp_path / "two", *asked)) == 0
    assert meaning(tmp_path / "one") == meaning(tmp_path / "two")


def test_too_many_are_refused_with_the_option(cluster, run, tmp_path, capsys):
    cluster.complete()
    asked = arguments(tmp_path / "out", "--expert=expert", "--seeds=0-9", "--engine=ray", "--slots=9")
    assert run(*asked) == 2
    assert (
        "9 simulators need 9 CPUs; the Ray cluster has 4. Use --num-workers=4 or fewer"
        in capsys.readouterr().err
    )


def test_the_command_joins_a_cluster_and_leaves_it(cluster, run, tmp_path, capsys):
    import ray

    cluster.complete()
    policy = save_policy(tmp_path / "policy")
    asked = [f"--policy.path={policy}", "--seeds=0", "--frames=none", "--env.obs_type=state", "--engine=ray"]
    ray.shutdown()
    try:
        assert run(*arguments(tmp_path / "out", *asked, f"--ray-address={cluster.address}")) in (0, 1)
        assert len(journal(tmp_path / "out.work" / "rollouts.jsonl")) == 2
        assert not ray.is_initialized()
        capsys.readouterr()
        assert run(*arguments(tmp_path / "none", *asked, "--ray-address=127.0.0.1:1")) == 2
        said = capsys.readouterr().err
        assert "--ray-address=127.0.0.1:1: no Ray cluster there" in said
        assert "--engine=local" in said
    finally:
        ray.init(address=cluster.address, log_to_driver=False, ignore_reinit_error=True)
