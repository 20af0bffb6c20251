"""Collection without LeRobot: starts, streams, records, perturbation, slots, and what breaks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lerobot_roborecover.curation.collect.judge import (
    FilterConfig,
    verdict,
)
from lerobot_roborecover.curation.collect.record import (
    pack_record,
    read_record,
    record_path,
)
from lerobot_roborecover.curation.collect.rollouts import RolloutJournal, RolloutOutcome, run_expert
from lerobot_roborecover.curation.collect.server import SERVER, CollectServer, VideoJob
from lerobot_roborecover.curation.collect.starts import make_units
from lerobot_roborecover.platforms import make_simulator
from lerobot_roborecover.platforms.catalog import choose_tasks
from lerobot_roborecover.platforms.fake import PLATFORM as FAKE
from lerobot_roborecover.platforms.limits import limits_of
from lerobot_roborecover.platforms.starts import Starts, parse_numbers, stream
from lerobot_roborecover.replay.recorder import PERTURBED, UNPERTURBED, UNREACHABLE
from lerobot_roborecover.scenario import Reset, Rollout, ScenarioError, Task
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.workers.messages import InProgress, SlotConfig
from lerobot_roborecover.workers.slots import SlotPool
from tests.support.processes import PATIENCE_S

TASK = Task("fake", "toy", "push-left", "push", 60)


def units(seeds=(0, 1, 2), *, perturbed=False, tasks=("toy",), trials=1, horizon=25):
    chosen = [replace(t, horizon=horizon) for t in choose_tasks(FAKE.tasks(), tasks)]
    return make_units(
        chosen, Starts(seeds=tuple(seeds), trials=trials), "expert_biased", FAKE.no_op(),
        perturbed=perturbed,
    )  # fmt: skip


def config(seed=5):
    settings_ = {"seed": seed, "expert": "expert_biased", "perturbed_steps": 20}
    return SlotConfig("fake", {}, server=SERVER, settings=settings_)


def ask(server, command, argument):
    """A command to its end, as the dispatcher gives it."""
    reply = server.answer(command, argument)
    while isinstance(reply, InProgress):
        reply = server.answer(command)
    return reply


def drive(server, folder, planned):
    """A rollout to its end, its record kept as the book does."""
    ended, record = ask(server, "roll_out", planned)
    atomic_write(record_path(folder, planned.record_name), record)
    return ended


def contents(folder):
    """Everything that a record holds, by rollout."""
    found = {}
    for path in sorted(folder.glob("*.npz")):
        r = read_record(path)
        found[path.stem] = [
            r.actions.tobytes(), r.steps.perturbation.tobytes(), r.steps.solved.tobytes(),
            *(p.tobytes() for p in r.steps.bodies.values()),
        ]  # fmt: skip
    return found


# --- starts


@given(short=st.integers(1, 30), more=st.integers(0, 30), seed=st.integers(0, 99))
@settings(max_examples=40, deadline=None)
def test_a_longer_draw_begins_with_the_shorter_and_never_repeats(short, more, seed):
    one = [r.seed for r in Starts(draw=short, seed=seed).by_seed(TASK)]
    two = [r.seed for r in Starts(draw=short + more, seed=seed).by_seed(TASK)]
    assert two[:short] == one
    assert len(set(two)) == short + more
    other = replace(TASK, name="push-right")
    assert [r.seed for r in Starts(draw=short, seed=seed).by_seed(other)] != one


@given(st.lists(st.tuples(st.integers(0, 500), st.integers(0, 20)), min_size=1, max_size=6))
def test_numbers_are_read_as_written(ranges):
    text = ",".join(f"{a}-{a + n}" if n else str(a) for a, n in ranges)
    expected = [k for a, n in ranges for k in range(a, a + n + 1)]
    if len(set(expected)) < len(expected):
        with pytest.raises(ScenarioError, match="twice"):
            parse_numbers(text, "--seeds")
    else:
        assert parse_numbers(text, "--seeds") == tuple(expected)


@pytest.mark.parametrize("text", ["", "3-1", "a", "-4", "1.5", "0-99999999", "5000000000", "1-2-3"])
def test_other_numbers_are_refused(text):
    with pytest.raises(ScenarioError, match="--seeds"):
        parse_numbers(text, "--seeds")


def test_tasks_by_suite_name_and_pattern():
    tasks = FAKE.tasks()
    names = lambda *p: [t.name for t in choose_tasks(tasks, p)]  # noqa: E731
    assert names("toy") == names("push-*") == names("toy/*") == ["push-left", "push-right"]
    assert names("toy/push-right", "push-left", "push-left") == ["push-left", "push-right"]
    with pytest.raises(ScenarioError, match="push-left"):
        names("push-lefd")
    with pytest.raises(ScenarioError, match="--task"):
        names()


@pytest.mark.parametrize(
    ("starts", "message"),
    [
        ({}, "none of them"),
        ({"seeds": (1,), "draw": 3}, "seeds and draw"),
        ({"draw": 3, "trials": 0}, "--trials"),
    ],
)
def test_starts_that_say_nothing_or_too_much(starts, message):
    with pytest.raises(ScenarioError, match=message):
        Starts(**starts)


def test_each_platform_has_its_own_starts():
    with pytest.raises(ScenarioError, match="--seeds or --draw"):
        Starts(init_states=(0,)).by_seed(TASK)


def test_ids_are_unique_and_fit_whatever_drives():
    made = units(range(4), trials=3)
    assert len({u.id for u in made}) == 2 * 4 * 3
    name = "org/a checkpoint of a very long name, indeed longer than an id may be, " * 3
    ids = [
        make_units([TASK], Starts(seeds=(4,)), n, np.zeros(2), perturbed=True)[0].id
        for n in (name, name + "x", "org/a", "org-a")
    ]
    assert len(set(ids)) == 4
    assert all(len(i) <= 128 for i in ids)


# --- records


@pytest.mark.slow
@given(order=st.permutations(range(6)), split=st.integers(0, 6))
@settings(max_examples=8, deadline=None)
def test_a_rollout_depends_on_its_start_alone(order, split, tmp_path_factory):
    """Whichever server drives it, after whichever others."""
    made = units((0, 1, 2), perturbed=True)
    folders = [tmp_path_factory.mktemp("records") for _ in range(2)]
    one = CollectServer(config())
    for scenario in made:
        drive(one, folders[0], scenario)
    servers = [CollectServer(config()) for _ in range(2)]
    for place, index in enumerate(order):
        drive(servers[place >= split], folders[1], made[index])
    assert contents(folders[0]) == contents(folders[1])
    assert len(contents(folders[0])) == 6


def test_perturbation_is_the_papers_and_stops_where_the_platform_cannot_follow(tmp_path):
    (scenario,) = (u for u in units((3,), perturbed=True) if u.task.name == "push-left")
    near_wall = np.array([0.9, 0.0])  # the mass runs into a wall: some perturbed commands lead through it

    class Straight:
        def __call__(self, _t):
            return near_wall

    import lerobot_roborecover.curation.collect.server as server

    original = server.make_controller
    server.make_controller = lambda *_: Straight()
    try:
        drive(CollectServer(config()), tmp_path, replace(scenario, task=replace(TASK, horizon=60)))
    finally:
        server.make_controller = original
    record = read_record(record_path(tmp_path, scenario.id))
    settle = scenario.reset.settle_steps
    noise = stream(5, "perturbation", TASK, scenario.reset, 0)
    simulator = make_simulator("fake")
    simulator.reset(TASK, record.reset)
    flags = []
    for t, (action, flag) in enumerate(zip(record.actions, record.steps.perturbation, strict=True)):
        given_ = np.zeros(2) if t < settle else near_wall
        if settle <= t < settle + 20:
            noisy = given_ + noise.uniform(-1, 1, 3)[:2]
            reachable = simulator.reachable(noisy)
            assert flag == (PERTURBED if reachable else UNREACHABLE)
            assert np.array_equal(action, noisy if reachable else given_)
        else:
            assert flag == UNPERTURBED
            assert np.array_equal(action, given_)
        simulator.step(action)
        flags.append(int(flag))
    assert flags.count(PERTURBED) > 5
    twin = replace(scenario, twin=True)
    drive(CollectServer(config()), tmp_path, twin)
    assert not read_record(record_path(tmp_path, twin.record_name)).steps.perturbation.any()


def test_reach_decides_at_the_walls():
    simulator = make_simulator("fake")
    simulator.reset(TASK, Reset(seed=0))
    assert limits_of(simulator) is simulator
    assert simulator.reachable(np.array([1.0, 0.0]))
    for _ in range(200):
        simulator.step(np.array([1.0, 0.0]))
    assert not simulator.reachable(np.array([1.0, 0.0]))
    assert simulator.reachable(np.array([-1.0, 0.0]))


def test_a_replay_is_compared_with_the_rollout(tmp_path):
    server = CollectServer(config())
    scenario = units((0,))[0]
    drive(server, tmp_path, scenario)
    record = read_record(record_path(tmp_path, scenario.id))
    poses = np.stack(list(record.steps.bodies.values()))
    job = VideoJob(Rollout(scenario.task, record.reset, record.actions), tuple(record.steps.bodies), poses)
    plain = CollectServer(SlotConfig("fake", {}, server=SERVER))
    rendered = ask(plain, "render", job)
    assert rendered.error_m == 0.0
    assert len(rendered.observations) == len(record.actions)
    assert np.array_equal(rendered.observations[-1]["agent_pos"][:2], record.steps.bodies["eef"][-2, :2])
    shifted = poses.copy()
    shifted[0, 7, 1] += 0.01
    assert ask(plain, "render", replace(job, poses=shifted)).error_m == pytest.approx(0.01)


@pytest.mark.parametrize(
    "odd", ["push it", [{"at": 1.0}], np.zeros((4, 4, 3), np.uint8), np.array([None])]
)  # fmt: skip
def test_observations_that_are_no_numbers_are_left_to_a_replay(tmp_path, odd):
    server = CollectServer(replace(config(), settings={**config().settings, "observe_every": 2}))
    (planned, *_) = units()
    drive(server, tmp_path, planned)
    record = read_record(record_path(tmp_path, planned.record_name))
    assert len(record.observations) == len(record.actions)
    np.testing.assert_equal(record.observations[1], record.observations[0])
    again = tmp_path / "again.npz"
    again.write_bytes(pack_record(record))
    np.testing.assert_equal(read_record(again).observations, record.observations)
    record.observations = [{**o, "more": {"odd": odd}} for o in record.observations]
    again.write_bytes(pack_record(record))
    assert read_record(again).observations is None


def test_damaged_records_say_so(tmp_path):
    path = record_path(tmp_path, "one")
    with pytest.raises(ScenarioError, match="Delete it"):
        read_record(path)
    path.write_bytes(b"PK\x03\x04 not a record")
    with pytest.raises(ScenarioError, match="Delete it"):
        read_record(path)


# --- slots


def roll(work, made, slots, stop_after=None):
    """Rolls out in worker processes; as collect does, but for LeRobot."""
    book = RolloutJournal(work)
    ended = []

    def on_end(end, record):
        book.add(end, record)
        ended.append(end.rollout)
        if stop_after is not None and len(ended) == stop_after:
            raise KeyboardInterrupt

    pool = SlotPool(config(), workers=True, timeout_s=PATIENCE_S)
    pool.acquire()
    try:
        run_expert([u for u in made if book.find(u.id) is None], pool, slots, on_end)
    finally:
        pool.release()
        book.close()
    return ended


@pytest.mark.slow
def test_slots_and_interruption_change_nothing(tmp_path):
    made = units(range(3), perturbed=True)
    roll(tmp_path / "one", made, 1)
    with pytest.raises(KeyboardInterrupt):
        roll(tmp_path / "two", made, 2, stop_after=2)
    rest = roll(tmp_path / "two", list(reversed(made)), 2)
    assert len(rest) == 4  # what had ended was not run again
    assert contents(tmp_path / "one" / "rollouts") == contents(tmp_path / "two" / "rollouts")


@pytest.mark.slow
def test_a_breaking_simulator_costs_its_rollout_alone(tmp_path):
    made = [*units((0,), tasks=("faults/raises", "faults/exits"), horizon=30), *units((0,))]
    ended = roll(tmp_path, made, 1)
    assert len(ended) == len(made)
    book = RolloutJournal(tmp_path)
    try:
        outcomes = {u.task.name: book.find(u.id).outcome for u in made}
        assert outcomes["raises"] == outcomes["exits"] == "sim_error"
        assert outcomes["push-left"] in ("success", "horizon")
        broken = next(u for u in made if u.task.name == "raises")
        found = verdict(broken, book.find(broken.id), book, FilterConfig())
        assert found.dropped.reason == "not run to its end: sim_error"
        assert "on purpose" in found.dropped.detail
        assert book.find(broken.id, retry_errors=True) is None
        whole = next(u for u in made if u.task.name == "push-left")
        record_path(book.records, whole.id).unlink()
        assert book.find(whole.id) is None  # without its record it is run again
    finally:
        book.close()


def test_the_journal_is_one_process_own(tmp_path):
    book = RolloutJournal(tmp_path)
    with pytest.raises(ScenarioError, match="another process"):
        RolloutJournal(tmp_path)
    book.add(RolloutOutcome("a", "success", 3), b"")
    book.close()
    (tmp_path / "rollouts.jsonl").open("a").write('{"schema": 1, "rollout": "b", "outcome": "won"}\n')
    with pytest.raises(ScenarioError, match="not a rollout's end"):
        RolloutJournal(tmp_path)
