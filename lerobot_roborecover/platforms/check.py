"""Whether a platform keeps the contract of `Simulator`: exact resets and replays, snapshots as exact as
claimed.

What cannot be rebuilt exactly is found here, with what differs, before a scenario is recorded. A run of
random actions is the yardstick: the hash of the complete state after every step must be the same in the same
process, after other tasks and seeds, with pictures taken in between, and in a fresh process.

    python -m lerobot_roborecover.platforms.check REQUEST    (JSON; the fresh process of `check_platform`)
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from typing import Any

import numpy as np

from lerobot_roborecover.errors import RoboRecoverError, check_seed
from lerobot_roborecover.platforms import Platform, Simulator, platform_named
from lerobot_roborecover.platforms.findings import Check, Status
from lerobot_roborecover.platforms.probe import answer, last_answer
from lerobot_roborecover.platforms.simulator import ShowsProgress, follow, iter_steps
from lerobot_roborecover.scenario import HANDOFF_TOLERANCE_M, Pose, Reset, Rollout, Task

STEPS = 40
TASKS = 2
STALE_MM = 1e3 * HANDOFF_TOLERANCE_M
"""Poses of one and the same state are no farther apart: some engines add a physics step's motion after they
have worked them out."""
_FRESH_TIMEOUT_S = 600.0
_HEAVY = ("torch", "lerobot")
"""Modules that make a worker start in fifteen seconds instead of one."""


@dataclass(frozen=True)
class CheckRequest:
    """Options of a platform check."""

    platform: str
    tasks: tuple[Task, ...]
    """Each is checked; the others come in between."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of the simulator."""
    steps: int = STEPS
    """Random actions of a run."""
    seed: int = 0
    """Seed of the actions."""

    def __post_init__(self):
        check_seed(self.seed)


@dataclass(frozen=True)
class Trace:
    """One run: T actions from a reset."""

    hashes: tuple[str, ...]
    """T + 1 hashes of the complete state."""
    success: tuple[bool, ...]
    """T + 1 answers of the task's predicate."""
    bodies: Mapping[str, Pose]
    """At the end."""
    parts: tuple[Mapping[str, str], ...] = ()
    """T + 1 hashes by part of the state, of simulators that tell (`state_parts`)."""

    def difference(self, other: Trace) -> str:
        """Where another run leaves this one, and by how much at its end; empty where it does not."""
        step = next(
            (i for i, (a, b) in enumerate(zip(self.hashes, other.hashes, strict=True)) if a != b), None
        )
        if step is None and self.success == other.success:
            return ""
        if step is None:
            return "the same states, but another answer of the success predicate"
        away = [1e3 * p.distance_m(other.bodies[n]) for n, p in self.bodies.items() if n in other.bodies]
        which = ""
        if self.parts and other.parts:
            one, two = self.parts[step], other.parts[step]
            which = f" in {', '.join(n for n in one if one[n] != two.get(n))}"
        return (
            f"states differ{which} from step {step} of {len(self.hashes) - 1} on; at the end bodies are up "
            f"to {max(away, default=0.0):.4g} mm away"
        )


def check_platform(request: CheckRequest) -> Iterator[Check]:
    """Runs every check, each as soon as the one before has ended.

    Args:
        request: what to run.

    Raises:
        RoboRecoverError: the simulator cannot be made at all.
    """
    platform = platform_named(request.platform)
    simulator = platform.make_simulator(**request.options)
    try:
        yield from _declarations(platform, simulator)
        yield _guarded("a step before a reset", lambda: _refused_step(platform, simulator))
        yield _guarded("an unknown task", lambda: _refused_task(simulator, request.tasks[0]))
        first: dict[Task, Trace] = {}
        for task in request.tasks:
            yield from _task_checks(platform, simulator, task, request, first)
        if len(first) > 1:
            for task, trace in first.items():
                again = _guarded_trace(platform, simulator, task, request)
                yield _same(f"{task.name}: replay after other tasks", trace, again)
    finally:
        simulator.close()
    if first:
        yield from _fresh_process(request, first)


def actions_for(platform: Platform, simulator: Simulator, request: CheckRequest) -> np.ndarray:
    """(T, A) float64 random actions."""
    rng = np.random.default_rng(request.seed)
    own = getattr(simulator, "random_actions", None)  # of one that knows its own space
    if own is not None:
        return own(rng, request.steps)
    return platform.random_actions(rng, request.steps, simulator.action_dim)


def run(simulator: Simulator, task: Task, reset: Reset, actions: np.ndarray, *, look: bool = False) -> Trace:
    """Runs actions from a reset.

    Args:
        simulator: to drive.
        task: to reset to.
        reset: its first state.
        actions: (T, A) float64.
        look: observe, render and ask for progress after every step.
    """
    hashes, success, parts = [], [], []
    tell = getattr(simulator, "state_parts", None)
    for step in iter_steps(simulator, Rollout(task, reset, actions)):
        hashes.append(simulator.state_sha256())
        if tell is not None:
            parts.append(tell())
        success.append(simulator.succeeded())
        if look and step < len(actions):
            simulator.observe()
            simulator.render()
            if isinstance(simulator, ShowsProgress):
                simulator.progress()
    return Trace(tuple(hashes), tuple(success), simulator.bodies(), tuple(parts))


def _declarations(platform: Platform, simulator: Simulator) -> Iterator[Check]:
    wrong = []
    if simulator.platform != platform.name:
        wrong.append(f"simulator.platform is {simulator.platform!r}, not {platform.name!r}")
    if simulator.action_dim not in platform.action_widths:
        wrong.append(f"action_dim {simulator.action_dim} is not of action_widths {platform.action_widths}")
    if not simulator.control_hz > 0:
        wrong.append(f"control_hz is {simulator.control_hz}")
    if platform.no_op().shape != (platform.action_widths[0],):
        wrong.append(f"no_op() has shape {platform.no_op().shape}")
    mark = simulator.fingerprint()
    if not mark or not all(isinstance(k, str) and isinstance(v, str) for k, v in mark.items()):
        wrong.append(
            f"fingerprint() is {mark!r:.200}; it names the versions that decide the physics, as text"
        )
    yield _verdict("declarations", wrong, f"{len(mark)} versions in the fingerprint")


def _refused_step(platform: Platform, simulator: Simulator) -> str:
    try:
        simulator.step(platform.no_op())
    except RoboRecoverError:
        return ""
    return "step() before reset() was executed; raise SimulatorError"


def _refused_task(simulator: Simulator, task: Task) -> str:
    unknown = Task(task.platform, task.suite, "no-such-task", "nothing", task.horizon)
    try:
        simulator.reset(unknown, Reset(seed=0))
    except RoboRecoverError:
        return ""
    return "reset() took a task that there is not; raise SimulatorError or ScenarioError, with what there is"


def _task_checks(
    platform: Platform, simulator: Simulator, task: Task, request: CheckRequest, first: dict[Task, Trace]
) -> Iterator[Check]:
    reset = platform.first_reset(task)
    actions = actions_for(platform, simulator, request)
    try:
        trace = run(simulator, task, reset, actions)
    except Exception as err:  # a simulator may raise whatever it likes
        yield Check(f"{task.name}: a run", Status.FAILURE, f"{type(err).__name__}: {err}"[:500])
        return
    first[task] = trace
    yield _state(simulator, task, trace)
    yield _same(f"{task.name}: replay", trace, _guarded_trace(platform, simulator, task, request))
    yield _other_seed(platform, simulator, task, request, trace)
    looked = partial(run, simulator, task, reset, actions, look=True)
    yield _guarded(f"{task.name}: pictures in between", lambda: trace.difference(looked()))
    yield _guarded(f"{task.name}: an action of another width", lambda: _refused_width(simulator, task, reset))
    yield _snapshots(simulator, task, reset, actions, trace)
    if simulator.snapshot_is_exact:
        yield _guarded(f"{task.name}: first places", lambda: _stale_places(simulator, task, reset))


def _state(simulator: Simulator, task: Task, trace: Trace) -> Check:
    wrong = []
    if not any(name.startswith("eef") for name in trace.bodies):
        wrong.append("bodies() names no end effector: a name that begins with 'eef'")
    if trace.success[0]:
        wrong.append("the task's predicate holds in its first state")
    if len(set(trace.hashes)) < len(trace.hashes) // 2:
        wrong.append("state_sha256() hardly changes: it must cover the complete state")
    try:
        if not simulator.observation_space.contains(simulator.observe()):
            wrong.append("observe() is not in observation_space: keys, shapes, dtypes or bounds differ")
    except Exception as err:  # a simulator may raise whatever it likes
        wrong.append(f"observe() fails: {type(err).__name__}: {err}"[:500])
    if isinstance(simulator, ShowsProgress):
        share, done = simulator.progress(), simulator.succeeded()
        if not 0.0 <= share <= 1.0 or (share == 1.0) != done:
            wrong.append(
                f"progress() is {share!r} where succeeded() is {done}: from 0 to 1, and 1 on success alone"
            )
    return _verdict(f"{task.name}: state", wrong, f"{len(trace.bodies)} bodies")


def _refused_width(simulator: Simulator, task: Task, reset: Reset) -> str:
    simulator.reset(task, reset)
    try:
        simulator.step(np.zeros(simulator.action_dim + 1))
    except Exception:  # any refusal will do
        return ""
    return f"an action of {simulator.action_dim + 1} values was executed; raise SimulatorError"


def _other_seed(
    platform: Platform, simulator: Simulator, task: Task, request: CheckRequest, trace: Trace
) -> Check:
    """Another start in between must leave no trace; and must be another start."""
    name = f"{task.name}: replay after another start"
    try:
        other = platform.another_reset(task, 1)
        between = run(simulator, task, other, actions_for(platform, simulator, request)[:5])
    except Exception as err:
        return Check(name, Status.FAILURE, f"{type(err).__name__}: {err}"[:500])
    if between.hashes[0] == trace.hashes[0]:
        why = "the second start has the first one's state: does the seed decide anything?"
        return Check(name, Status.WARNING, why, "a task with one start alone needs no seed; say so")
    return _same(name, trace, _guarded_trace(platform, simulator, task, request))


def _snapshots(simulator: Simulator, task: Task, reset: Reset, actions: np.ndarray, trace: Trace) -> Check:
    name, middle = f"{task.name}: snapshots", len(actions) // 2
    try:
        kept = b""
        for step in iter_steps(simulator, Rollout(task, reset, actions)):
            if step == middle:
                kept = simulator.snapshot()
        simulator.reset(task, reset)
        simulator.restore(kept)
        # Observations, and with them the hash, are valid only after a further step.
        hashes = [simulator.state_sha256() for step in follow(simulator, actions[middle:]) if step]
        away = max(1e3 * p.distance_m(trace.bodies[n]) for n, p in simulator.bodies().items())
    except Exception as err:
        if not simulator.snapshot_is_exact:
            return Check(
                name, Status.OK, f"none ({type(err).__name__}), and none claimed: replay is the rule"
            )
        return Check(name, Status.FAILURE, f"{type(err).__name__}: {err}"[:500])
    exact = tuple(hashes) == trace.hashes[middle + 1 :]
    if exact or not simulator.snapshot_is_exact:
        what = "continue bit for bit" if exact else f"drift by {away:.4g} mm, and are not called exact"
        return Check(name, Status.OK, f"{len(kept)} bytes; they {what}")
    return Check(
        name,
        Status.FAILURE,
        f"snapshot_is_exact, but a restored one drifts by {away:.4g} mm in {len(actions) - middle} steps",
        "save what is missing (solver warm starts, controllers, counters), or set snapshot_is_exact = False",
    )


def _stale_places(simulator: Simulator, task: Task, reset: Reset) -> str:
    """A reset that moves a body and does not work out where its parts are then: the first step would seem to
    have moved them."""
    simulator.reset(task, reset)
    first = simulator.bodies()
    simulator.restore(simulator.snapshot())
    again = simulator.bodies()
    name = max(first, key=lambda n: first[n].distance_m(again[n]))
    away = 1e3 * first[name].distance_m(again[name])
    if away < STALE_MM:
        return ""
    return (
        f"right after reset() bodies() has {name} {away:.4g} mm from where the same state has it once it is "
        "restored: work out the poses before they are read"
    )


def _fresh_process(request: CheckRequest, first: Mapping[Task, Trace]) -> Iterator[Check]:
    asked = json.dumps({**asdict(request), "tasks": [asdict(task) for task in first]})
    name = "a fresh process"
    try:
        done = subprocess.run(
            [sys.executable, "-m", "lerobot_roborecover.platforms.check", asked],
            capture_output=True, text=True, errors="replace", timeout=_FRESH_TIMEOUT_S,
            stdin=subprocess.DEVNULL,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        yield Check(name, Status.FAILURE, f"no answer within {_FRESH_TIMEOUT_S:g} s")
        return
    found = last_answer(done.stdout)
    if found is None:
        lines = done.stderr.strip().splitlines()
        yield Check(name, Status.FAILURE, lines[-1][:500] if lines else f"exit status {done.returncode}")
        return
    for task, trace in first.items():
        equal = found["hashes"].get(f"{task.suite}/{task.name}") == list(trace.hashes)
        yield Check(
            f"{task.name}: replay in a fresh process",
            Status.OK if equal else Status.FAILURE,
            "identical" if equal else "states differ from those of this process",
            ""
            if equal
            else "something survives a reset here, or is drawn at import: seeds, caches, counters",
        )
    heavy = found["heavy"]
    yield Check(
        "imports of a worker",
        Status.WARNING if heavy else Status.OK,
        f"{' and '.join(heavy)} are imported: a worker starts in 15 s instead of 1" if heavy else "light",
        "import them where they are needed, not in simulators" if heavy else "",
    )


def _guarded_trace(
    platform: Platform, simulator: Simulator, task: Task, request: CheckRequest
) -> Trace | str:
    try:
        return run(simulator, task, platform.first_reset(task), actions_for(platform, simulator, request))
    except Exception as err:
        return f"{type(err).__name__}: {err}"[:500]


def _same(name: str, one: Trace, two: Trace | str) -> Check:
    problem = two if isinstance(two, str) else one.difference(two)
    remedy = "a reset must put back everything: see docs/platforms.md, 'What makes a reset exact'"
    return _verdict(name, [problem] if problem else [], f"{len(one.hashes)} states identical", remedy)


def _guarded(name: str, ask: Callable[[], str]) -> Check:
    try:
        problem = ask()
    except RoboRecoverError as err:  # such as no OpenGL here
        return Check(name, Status.WARNING, f"could not be checked: {err}"[:500])
    except Exception as err:
        return Check(name, Status.FAILURE, f"{type(err).__name__}: {err}"[:500])
    return _verdict(name, [problem] if problem else [], "as it should be")


def _verdict(name: str, wrong: Sequence[str], right: str, remedy: str = "see docs/platforms.md") -> Check:
    if wrong:
        return Check(name, Status.FAILURE, "; ".join(wrong), remedy)
    return Check(name, Status.OK, right)


def main(asked: str) -> None:
    """Answers with the hashes of every task's run, and with the heavy modules that were imported."""
    values = json.loads(asked)
    request = CheckRequest(**values | {"tasks": tuple(Task(**task) for task in values["tasks"])})
    platform = platform_named(request.platform)
    simulator = platform.make_simulator(**request.options)
    hashes = {}
    for task in request.tasks:
        actions = actions_for(platform, simulator, request)
        trace = run(simulator, task, platform.first_reset(task), actions)
        hashes[f"{task.suite}/{task.name}"] = trace.hashes
    simulator.close()
    answer({"hashes": hashes, "heavy": [m for m in _HEAVY if m in sys.modules]})


if __name__ == "__main__":
    main(sys.argv[1])
