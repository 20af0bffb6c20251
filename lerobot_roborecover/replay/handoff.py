"""Rebuilds a recovery point: reset, replay the prefix without rendering, compare with what was recorded.

The order that makes it exact and fast (paper, "Recovery Scenario and Evaluation"):

0. the simulator's robot must be the one that recorded (`platforms.robot_fingerprint`), or nothing holds;
1. put the task in its exact first state;
2. replay all but the last action of the prefix, rendering nothing;
3. where snapshots are exact, take one here, so that a later trial can start from it;
4. replay the last action, which also regenerates contacts, observation clocks and the success predicate;
5. compare end effectors and objects with the scenario's fingerprint, and ask the predicate.
"""

from __future__ import annotations

import hashlib
import time
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from lerobot_roborecover.platforms.robot_fingerprint import NAME, compare_robots, is_robot_entry
from lerobot_roborecover.platforms.simulator import Simulator, SimulatorError, advance, follow
from lerobot_roborecover.scenario import (
    HANDOFF_TOLERANCE_M,
    Fingerprint,
    Outcome,
    Pose,
    Reset,
    Rollout,
    Scenario,
    ScenarioError,
    Start,
    TrialStart,
)
from lerobot_roborecover.utils.atomic_io import atomic_write


class SnapshotCache:
    """Handoff snapshots by key, the least recently used dropped; optionally kept on disk as well.

    Args:
        max_bytes: memory the snapshots may take.
        folder: where to keep them between runs; None keeps them in memory alone.
        approximate: also serve simulators whose snapshots are not exact: the state is restored, but the
            steps after it drift from a replay. Off by default.
    """

    def __init__(self, max_bytes: int = 64 * 2**20, folder: Path | None = None, *, approximate: bool = False):
        self.approximate = approximate
        self._max_bytes = max_bytes
        self._folder = folder
        self._entries: OrderedDict[str, tuple[bytes, str]] = OrderedDict()
        self._bytes = 0
        self.rejected: set[str] = set()
        """Keys whose restored state once differed from a replay's: never used again."""

    def get(self, key: str) -> tuple[bytes, str] | None:
        """The snapshot and the state hash that one step after it must give, or None."""
        if key in self.rejected:
            return None
        if key in self._entries:
            self._entries.move_to_end(key)
            return self._entries[key]
        if self._folder is not None:
            try:
                raw = (self._folder / f"{key}.snapshot").read_bytes()
            except OSError:
                return None
            digest, body = raw[:32], raw[32:]
            if hashlib.sha256(body).digest() != digest:
                return None
            entry = (body[64:], body[:64].decode())
            self._remember(key, entry)
            return entry
        return None

    def put(self, key: str, snapshot: bytes, state_sha256: str) -> None:
        """Keeps a snapshot together with the state hash it leads to."""
        self._remember(key, (snapshot, state_sha256))
        if self._folder is not None:
            body = state_sha256.encode() + snapshot
            # A full disk costs a replay later; it is not to cost the trial.
            with suppress(OSError):
                atomic_write(self._folder / f"{key}.snapshot", hashlib.sha256(body).digest() + body)

    def reject(self, key: str) -> None:
        """Drops a snapshot that did not lead to the replayed state, for good."""
        self.rejected.add(key)
        entry = self._entries.pop(key, None)
        if entry:
            self._bytes -= len(entry[0])
        if self._folder is not None:
            (self._folder / f"{key}.snapshot").unlink(missing_ok=True)

    def _remember(self, key: str, entry: tuple[bytes, str]) -> None:
        if key in self._entries:
            self._bytes -= len(self._entries.pop(key)[0])
        self._entries[key] = entry
        self._bytes += len(entry[0])
        while self._bytes > self._max_bytes and len(self._entries) > 1:
            self._bytes -= len(self._entries.popitem(last=False)[1][0])


def snapshot_key(rollout: Rollout, step: int, versions: Mapping[str, str]) -> str:
    """Cache key of a handoff: what is replayed, handoff step, and the versions that decide the physics."""
    text = f"{rollout.sha256()} {step} {sorted(versions.items())}"
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass(frozen=True)
class Handoff:
    """What the simulator looked like when the policy was about to take over."""

    step: int
    """Prefix actions replayed."""
    seconds: float
    """Wall time of reset, replay and check."""
    from_snapshot: bool
    """Whether a cached snapshot stood in for the replay."""
    state_sha256: str
    """Hash of the complete simulator state."""
    eef_error_mm: float | None
    """Largest end-effector displacement from the fingerprint; None where there is nothing to compare with."""
    object_error_mm: float | None
    """Largest object displacement from the fingerprint; None where there is nothing to compare with."""
    identical: bool | None
    """Whether the simulator state equals the recorded one bit for bit; None where there is nothing to compare
    with."""
    problem: Outcome | None
    """`state_mismatch` or `solved_by_prefix` when the policy must not run, else None."""
    reason: str = ""
    """The problem in words."""


def hand_off(
    simulator: Simulator,
    scenario: TrialStart,
    start: Start = Start.RECOVERY,
    *,
    rewind_steps: int = 0,
    check: bool = True,
    cache: SnapshotCache | None = None,
) -> Handoff:
    """Brings the simulator to the point where the policy takes over.

    Args:
        simulator: any platform's; left at the handoff, ready for `observe`.
        scenario: what to rebuild.
        start: recovery point, initial state, or some steps before the recovery point.
        rewind_steps: how many, for `Start.REVERSION`.
        check: compare with the fingerprint; a displacement beyond 2 mm makes the trial a `state_mismatch`.
        cache: snapshots of earlier handoffs, used where the simulator's are exact.

    Raises:
        SimulatorError: the simulator cannot be reset or stepped, or has another robot than the one that
            recorded, which is never a `state_mismatch`.
    """
    began = time.perf_counter()
    if check:
        check_robot(simulator, scenario)
    step = scenario.handoff_step(start, rewind_steps)
    state, from_snapshot = replay_to(simulator, scenario.rollout, step, cache)
    handoff = Handoff(step, 0.0, from_snapshot, state, None, None, None, None)
    if check and scenario.fingerprint is not None and step == scenario.fingerprint.step:
        handoff = _compare(handoff, simulator.bodies(), scenario.fingerprint)
    if handoff.problem is None and simulator.succeeded():
        handoff = replace(
            handoff,
            problem=Outcome.SOLVED_BY_PREFIX,
            reason=f"the task's predicate already holds after {step} replayed actions",
        )
    return replace(handoff, seconds=time.perf_counter() - began)


def check_robot(simulator: Simulator, scenario: TrialStart) -> None:
    """Checks that the simulator has the robot that recorded a scenario, as far as its fingerprint, if it has
    one, says.

    Raises:
        SimulatorError: another one; the message says in what it differs, worst first.
    """
    # To ask a simulator what it is made of takes longer than to restore a snapshot.
    if scenario.fingerprint is None or not any(map(is_robot_entry, scenario.fingerprint.versions)):
        return
    here = simulator.fingerprint()
    robots = compare_robots(scenario.fingerprint.versions, here)
    if robots.another:
        raise SimulatorError(
            f"the robot {here.get(NAME, '')} here is another than the one that recorded scenario "
            f"{scenario.id}: {robots}. Nothing recorded there replays here: put the platform's own robot in "
            f"place (roborecover doctor --platform {scenario.platform} says how), or use scenarios that were "
            "recorded on this one"
        )


def replay_to(
    simulator: Simulator,
    rollout: Rollout,
    step: int,
    cache: SnapshotCache | None = None,
    on_state: Callable[[int], None] = lambda number: None,
) -> tuple[str, bool]:
    """Resets the task and replays the first `step` actions, or restores what that gave before.

    Args:
        simulator: left after the last of them, ready for `observe`.
        rollout: what to replay.
        step: number of actions.
        cache: snapshots of earlier replays, used where the simulator's are exact, or the cache approximate.
        on_state: called in each state before the last, with its number, where the actions are replayed.

    Returns:
        Hash of the simulator's state, and whether a snapshot stood in for the replay.
    """
    if cache is not None and cache.approximate and not simulator.snapshot_is_exact and step > 0:
        return _restore_to(simulator, rollout, step, cache), True
    if not simulator.snapshot_is_exact or step == 0:
        cache = None
    key = "" if cache is None else snapshot_key(rollout, step, simulator.fingerprint())
    cached = None if cache is None else cache.get(key)
    simulator.reset(rollout.task, rollout.reset)
    if cache is not None and cached is not None:
        snapshot, expected = cached
        simulator.restore(snapshot)
        simulator.step(rollout.actions[step - 1])
        state = simulator.state_sha256()
        if state == expected:
            return state, True
        cache.reject(key)
        simulator.reset(rollout.task, rollout.reset)
    for number in follow(simulator, rollout.actions[: max(step - 1, 0)]):
        if number < step:
            on_state(number)
    snapshot = simulator.snapshot() if cache is not None and key not in cache.rejected else None
    if step:
        simulator.step(rollout.actions[step - 1])
    state = simulator.state_sha256()
    if cache is not None and snapshot is not None:
        cache.put(key, snapshot, state)
    return state, False


def _restore_to(simulator: Simulator, rollout: Rollout, step: int, cache: SnapshotCache) -> str:
    """What `replay_to` does where snapshots give the state back but not its exact continuation.

    Every trial goes on from the restored snapshot, also the one that took it: what follows is then the same
    for all of them, whichever came first.
    """
    simulator.reset(rollout.task, rollout.reset)
    key = snapshot_key(rollout, step, simulator.fingerprint())
    cached = cache.get(key)
    if cached is None:
        advance(simulator, rollout.actions[:step])
        cached = simulator.snapshot(), simulator.state_sha256()
        cache.put(key, *cached)
        simulator.reset(rollout.task, rollout.reset)
    snapshot, state = cached
    simulator.restore(snapshot)
    if simulator.state_sha256() != state:
        raise SimulatorError(
            f"{rollout.task.name}: the cached snapshot of step {step} does not restore the state that it "
            "was taken of. Delete the folder of --env.snapshot_dir, or go without "
            "--env.approximate_snapshots"
        )
    return state


def _compare(handoff: Handoff, bodies: Mapping[str, Pose], fingerprint: Fingerprint) -> Handoff:
    """Fills in the displacements of end effectors and objects from the fingerprint."""
    missing = sorted(set(fingerprint.bodies) - set(bodies))
    if missing:
        return replace(
            handoff,
            problem=Outcome.STATE_MISMATCH,
            reason=(
                f"the simulator has no body {missing[0]!r} that the fingerprint names "
                f"({len(missing)} missing)"
            ),
        )
    distances = {name: bodies[name].distance_m(pose) for name, pose in fingerprint.bodies.items()}
    eef = max((d for n, d in distances.items() if n.startswith("eef")), default=0.0)
    objects = max((d for n, d in distances.items() if not n.startswith("eef")), default=0.0)
    identical = handoff.state_sha256 == fingerprint.state_sha256 if fingerprint.state_sha256 else None
    handoff = replace(handoff, eef_error_mm=eef * 1e3, object_error_mm=objects * 1e3, identical=identical)
    if max(eef, objects) > HANDOFF_TOLERANCE_M:
        worst = max(distances, key=distances.__getitem__)
        handoff = replace(
            handoff,
            problem=Outcome.STATE_MISMATCH,
            reason=(
                f"{worst} is {distances[worst] * 1e3:.2f} mm from where it was recorded; the limit is "
                f"{HANDOFF_TOLERANCE_M * 1e3:g} mm. Compare the versions in the fingerprint with yours "
                "(roborecover doctor)"
            ),
        )
    return handoff


def with_fixtures(simulator: Simulator, scenario: Scenario) -> Scenario:
    """Adds fixture poses to a scenario's reset, where the platform draws them and the reset lacks them."""
    if scenario.reset.fixtures:
        return scenario
    simulator.reset(scenario.task, scenario.reset)
    return replace(scenario, reset=replace(scenario.reset, fixtures=dict(simulator.fixtures())))


def with_fingerprint(
    simulator: Simulator, scenario: Scenario, frames_png: tuple[bytes, ...] = ()
) -> Scenario:
    """Replays a scenario that has no fingerprint yet and returns it with what `record_handoff` finds.

    Raises:
        ScenarioError: the prefix already solves the task, so that there is nothing to recover.
    """
    reset, fingerprint = record_handoff(simulator, scenario, frames_png)
    return replace(scenario, reset=reset, fingerprint=fingerprint)


def record_handoff(
    simulator: Simulator, scenario: Scenario, frames_png: tuple[bytes, ...] = ()
) -> tuple[Reset, Fingerprint]:
    """Replays a scenario to its handoff: its reset, with the fixture poses where the platform draws them at
    random and the scenario lacks them, and the handoff's fingerprint.

    Raises:
        ScenarioError: the prefix already solves the task, so that there is nothing to recover.
    """
    scenario = replace(with_fixtures(simulator, scenario), fingerprint=None)
    handoff = hand_off(simulator, scenario, check=False)
    if handoff.problem is Outcome.SOLVED_BY_PREFIX:
        raise ScenarioError(f"scenario {scenario.id}: {handoff.reason}; there is nothing to recover from")
    return scenario.reset, Fingerprint(
        step=handoff.step,
        bodies=simulator.bodies(),
        state_sha256=handoff.state_sha256,
        versions=simulator.fingerprint(),
        frames_png=frames_png,
    )
