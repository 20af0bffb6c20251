"""Teleoperation below the page: what is recorded is what happened, and nothing sent breaks the server."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.funnel import Decision, read_decisions, record_decisions
from lerobot_roborecover.curation.video_settings import VideoSettings, read_video_settings
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.web.teleop.client import Client, TeleopRefusal
from lerobot_roborecover.web.teleop.serve import view_options
from lerobot_roborecover.web.teleop.session import TeleopSession
from lerobot_roborecover.web.teleop.starts import continued, first_state
from lerobot_roborecover.web.teleop.store import Store, lacking, read_recording
from lerobot_roborecover.web.teleop.write import (
    _as_candidate,
    check_open,
    recordings_folder,
    write_dataset,
)
from tests.support.candidate_files import candidate_dataset
from tests.support.teleop_sessions import cockpit, push

# --- what is recorded


def states(simulator, start, actions) -> list[str]:
    simulator.reset(start.task, start.reset)
    found = [simulator.state_sha256()]
    for action in actions:
        simulator.step(action)
        found.append(simulator.state_sha256())
    return found


def check_exact(platform, task, moves, width, **options) -> None:
    """Drives and takes back at random; what is left must be what its actions alone give."""
    simulator, start = make_simulator(platform, **options), first_state(platform, task, seed=5)
    session = TeleopSession(simulator, "ann")
    session.start(start)
    rng = np.random.default_rng(len(moves))
    for move in moves:
        if move > 0:
            for _ in range(move):
                session.act(rng.uniform(-1, 1, width), "script")
        else:
            session.roll_back(-move)
    assert len(session.bodies) == len(session.solved) == session.step + 1
    assert states(make_simulator(platform, **options), start, session.actions)[-1] == simulator.state_sha256()
    assert session.bodies[-1] == simulator.bodies()
    if session.step:
        session.roll_back(1)
        session.act(last := rng.uniform(-1, 1, width), "script")
        again = states(make_simulator(platform, **options), start, [*session.actions[:-1], last])
        assert again[-1] == simulator.state_sha256()
    simulator.close()


@settings(max_examples=30, deadline=None)
@given(st.lists(st.integers(-30, 30).filter(bool), max_size=8))
def test_steps_taken_back_never_happened(moves):
    check_exact("fake", "push-left", moves, 2)


@pytest.mark.metaworld
def test_steps_taken_back_never_happened_on_metaworld():
    check_exact("metaworld", "push-v3", [25, -10, 230, -3, 5, -210, 4], 4, obs_type="state")


def test_a_mark_needs_a_deviation_and_goes_with_the_steps_before_it(address):
    with Client(address) as client:
        client.start("push-left", seed=3)
        with pytest.raises(TeleopRefusal, match="nothing has happened yet"):
            client.mark()
        client.act(np.full((12, 2), 0.1))
        with pytest.raises(TeleopRefusal, match="must be empty or one of Approach"):
            client.mark("Grasp")
        assert client.mark("Contact", "Wrong Pose")["mark"] == [12, "Contact", "Wrong Pose"]
        client.act([0.1, 0.1])
        assert client.back(1)["mark"] == [12, "Contact", "Wrong Pose"]
        assert client.back(1)["mark"] is None
        assert client.back(500)["step"] == 0
        with pytest.raises(TeleopRefusal, match="nothing was driven"):
            client.finish(as_dropped=True)
        client.act([0.1, 0.1])
        with pytest.raises(TeleopRefusal, match="a recording is under way"):
            client.start("push-left")
        with pytest.raises(TeleopRefusal, match="no recovery point marked"):
            client.finish()
        push(client)
        with pytest.raises(TeleopRefusal, match="nothing to recover from"):
            client.mark()
        client.discard()
        with pytest.raises(TeleopRefusal, match="start a task first"):
            client.act([0, 0])
        with pytest.raises(TeleopRefusal, match="fake has no task"):
            client.start("../push")


def test_a_script_records_what_it_sent_bit_for_bit(tmp_path):
    rng = np.random.default_rng(0)
    sent = rng.uniform(-1, 1, (9, 2))
    with cockpit(tmp_path / "set.recordings") as found, Client(found) as client:
        client.start("push-left", seed=4)
        client.act(sent[0])
        client.act(sent[1:])
        client.mark()
        push(client)
        name = client.finish()
    (path,) = (tmp_path / "set.recordings").glob("recording-*.npz")
    saved = read_recording(path)
    assert (saved.id, saved.operator, saved.mark) == (name, "ann", (9, "", ""))
    assert saved.actions[:9].tobytes() == sent.tobytes()
    assert saved.lacks == ""
    assert saved.solved[-1]
    assert saved.notes["recovery_steps"] == len(saved.actions) - 9
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ScenarioError, match="not a whole recording"):
        read_recording(path)


def test_one_process_holds_a_datasets_recordings(tmp_path):
    first = Store(tmp_path / "r")
    with pytest.raises(ScenarioError, match="in use by another"):
        Store(tmp_path / "r")
    first.close()
    Store(tmp_path / "r").close()


def test_a_rollout_is_continued_from_any_of_its_steps(tmp_path):
    dataset = candidate_dataset(tmp_path / "natural", 2)
    start = continued(dataset, "ep-0001", 20)
    session = TeleopSession(make_simulator("fake"), "ann")
    session.start(start)
    assert session.step == 20
    recorded = read_candidates(dataset).steps(1).bodies["puck"][20, :3]
    assert session.bodies[-1]["puck"].position_m == tuple(recorded)
    session.act(np.array([1.0, 0.0]), "script")
    assert session.roll_back(50) == 1, "what came before was not driven here"
    session.act(np.array([1.0, 0.0]), "script")
    saved = session.recorded("x", as_dropped=True)
    assert saved.source_record == "ep-0001"
    assert saved.notes["continues"] == {
        "dataset": "natural", "candidate": "ep-0001", "step": 20, "driver": "noise",
    }  # fmt: skip
    for name, step, message in (("ep-9", 20, "no candidate"), ("ep-0001", 46, "steps 2 to 45")):
        with pytest.raises(ScenarioError, match=message):
            continued(dataset, name, step)


def test_a_proof_lies_within_the_horizon_from_the_mark(tmp_path):
    folder = tmp_path / "r"
    with cockpit(folder) as found, Client(found) as client:
        client.start("push-left", seed=4)
        client.act(np.full((5, 2), 0.5))
        horizon = client.mark()["horizon"]
        client.act(np.zeros((horizon - 1, 2)))
        assert client.status["lacks"] == "not solved after the mark"
        client.act(np.zeros((2, 2)))
        push(client)
        assert client.status["solved"]
        assert not client.status["proven"]
        with pytest.raises(TeleopRefusal, match="not solved within the horizon"):
            client.finish()
        client.finish(as_dropped=True)
    store = Store(folder)
    (path,) = store.paths()
    late = read_recording(path)
    assert late.lacks == "not solved within the horizon"
    assert np.flatnonzero(late.solved)[0] - late.mark[0] > horizon
    store.close()


def test_lacking_counts_the_horizon_from_the_mark_inclusive():
    solved = np.zeros(60, bool)
    assert lacking(None, solved, 45) == "no recovery point marked"
    solved[10 + 45] = True
    assert lacking(10, solved, 45) == ""
    assert lacking(10, solved, 44) == "not solved within the horizon"
    assert lacking(55, solved, 45) == "not solved after the mark"


def test_a_recording_of_an_earlier_version_is_held_against_the_horizon_when_written(tmp_path):
    store, simulator = Store(tmp_path / "r"), make_simulator("fake", **view_options("fake", 16))
    session = TeleopSession(simulator, "ann")
    session.start(first_state("fake", "push-left", seed=4))
    for _ in range(75):
        session.act(np.array([0.1, 0.0]), "script")
    late = replace(session.recorded("x", as_dropped=True), mark=(2, "", ""), lacks="")
    late.solved[-1] = True
    said = [
        _as_candidate(late, simulator, VideoSettings(1, {})),
        _as_candidate(replace(late, mark=None), simulator, VideoSettings(1, {})),
    ]
    assert [r.exclusion for r in said] == ["does not replay"] * 2
    assert said[0].exclusion_detail == "not solved after 75 steps of the replay"
    late.solved[-1] = False
    assert _as_candidate(late, simulator, VideoSettings(1, {})).exclusion == "not solved within the horizon"
    store.close()


@pytest.mark.lerobot
def test_the_dataset_holds_what_was_saved_and_grows_until_it_is_worked_on(tmp_path):
    out, said = tmp_path / "set", []
    folder = recordings_folder(out)
    options = ("fake", {}, 32, said.append, 4)
    check_open(out)
    with cockpit(folder) as found, Client(found) as client:
        client.start("push-left", seed=4)
        client.act(np.full((5, 2), 0.5))
        client.mark("Approach", "Wrong Pose")
        push(client)
        good = client.finish()
        client.start("push-left", seed=6)
        client.act(np.full((5, 2), 0.5))
        client.mark()
        bad = client.finish(as_dropped=True)
    store = Store(folder)
    assert write_dataset(out, store, *options)
    made = read_candidates(out)
    assert [c.id for c in made.candidates] == [good, bad]
    assert {c.source.value for c in made.candidates} == {"human"}
    assert [(s.step, s.by, s.stage) for s in made.candidates[0].suggestions] == [(5, "operator", "Approach")]
    assert made.row(0).driver == "ann"
    # Who renders its frames again (`validate`) does as was done here.
    video = read_video_settings(made.row(0).provenance, "here")
    assert (video.every, video.options["observation_size"]) == (4, 32)
    saved = read_recording(store.paths()[0])
    assert made.actions(0).tobytes() == saved.actions.tobytes()
    assert (made.steps(0).bodies["puck"] == saved.bodies["puck"]).all()
    decided = [(d.candidate, d.verdict, d.reason) for d in read_decisions(out)]
    assert decided == [(good, "kept", ""), (bad, "dropped", "not solved after the mark")]
    store.close()
    # A later session adds to it; a recording that does not replay is dropped with the distance.
    with cockpit(folder) as found, Client(found) as client:
        client.start("push-left", seed=7)
        client.act(np.full((5, 2), 0.5))
        client.mark()
        push(client)
        client.finish()
    store = Store(folder)
    path = store.paths()[2]
    kept = read_recording(path)
    kept.bodies["puck"][3, 0] += 0.01
    store.add(kept, 3)
    assert write_dataset(out, store, *options)
    assert read_decisions(out)[-1].reason == "does not replay"
    assert read_decisions(out)[-1].detail.startswith("10 mm off")
    assert len(read_candidates(out)) == 3
    assert [p.name for p in sorted(folder.glob("part-*"))] == ["part-000001-000003"]
    record_decisions(out, [Decision(good, "screen", "kept")])
    for refused in (lambda: check_open(out), lambda: write_dataset(out, store, *options)):
        with pytest.raises(ScenarioError, match="being worked on"):
            refused()
    store.close()


def test_a_recording_of_before_the_simulator_marked_more_still_replays():
    from lerobot_roborecover.web.teleop.write import _replay

    simulator = make_simulator("fake")
    session = TeleopSession(simulator, "ann")
    session.start(first_state("fake", "push-left", seed=5))
    for _ in range(4):
        session.act(np.full(2, 0.5), "keyboard")
    whole = session.recorded("it", as_dropped=True)
    earlier = replace(whole, bodies={name: whole.bodies[name] for name in list(whole.bodies)[:1]})
    assert len(earlier.bodies) < len(simulator.bodies())
    assert _replay(earlier, simulator)[0] == 0.0


# --- starts and pictures


# --- who may ask, and for what
