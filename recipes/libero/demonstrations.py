"""Demonstrations of LIBERO's tasks by the scripted expert as a LeRobotDataset, for `lerobot-train`.

Objects stand where LIBERO's own placement draws them, as in LIBERO's demonstrations: none of the stored
init states, from which policies are evaluated and scenarios are made, is among them. Every second episode is
clean; in the others the arm is perturbed for a while, while the recorded action stays the expert's, so that a
policy trained on them has seen states beside the expert's path.

    python -m recipes.libero.demonstrations --out DIR --workers 2
    python -m recipes.libero.demonstrations --out RECOVERIES --after policies/libero/act_clean
    python -m recipes.libero.demonstrations --out DIR64 --parts DIR.parts --pictures 64 --suites libero_object

With `--after`, policies drive first, every second one perturbed, and the expert takes over at a step that is
drawn, if the task is not solved by then: the episode begins there, and shows how to go on from where policies
get.

Each task's episodes are kept in `DIR.parts` once they are whole; a second call goes on from there. Pictures
are drawn while the same episodes are replayed.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lerobot_roborecover.curation.rollout import perturb_translations
from lerobot_roborecover.datasets.lerobot_folder import local_repo_id
from lerobot_roborecover.platforms.base import Controller
from lerobot_roborecover.platforms.libero.expert import LiberoExpert
from lerobot_roborecover.platforms.libero.platform import PLATFORM
from lerobot_roborecover.platforms.libero.scene import LiberoScene
from lerobot_roborecover.platforms.libero.simulator import LiberoSimulator
from lerobot_roborecover.platforms.simulator import SimulatorError
from lerobot_roborecover.platforms.starts import RELEASE_SEED
from lerobot_roborecover.scenario import Pose, Reset, Task
from lerobot_roborecover.utils.atomic_io import atomic_dir
from recipes.episodes import ACTION, ENVIRONMENT, REWARD, STATE, Episode, write_episodes
from recipes.learned import LearnedPolicy

FIRST_SEED, FIRST_SEED_AFTER = 20_000, 40_000
"""Seeds of demonstrations, and of those after a policy, start here."""
_TAKEN_OVER = (20, 0.6)
"""Step at which the expert takes over, at the earliest; and at the latest, of the task's horizon."""
_STEPS_AFTER_SUCCESS = 3
_GIVE_UP_AFTER = 3
"""Rollouts for each episode that is wanted."""
CAMERAS = ("image", "image2")
"""LeRobot's names of the scene's and the wrist's camera."""


@dataclass(frozen=True)
class Wanted:
    """What a worker makes of one task."""

    task: Task
    episodes: int
    pictures: int
    """Side, pixels; 0 for none."""
    part: Path
    after: tuple[str, ...] = ()
    """Checkpoints that drive first, in turn."""

    @property
    def drawn(self) -> Path:
        """The dataset of the task's episodes with pictures."""
        return self.part.with_name(f"{self.part.stem}.{self.pictures}px")


def tasks_of(suites: Sequence[str] | None) -> list[Task]:
    """The suites' tasks; all for None."""
    return [task for task in PLATFORM.tasks() if not suites or task.suite in suites]


def part_of(folder: Path, task: Task) -> Path:
    """The file of a task's episodes."""
    return folder / f"{PLATFORM.short_name(task)}.npz"


def place_freshly(simulator: LiberoSimulator, task: Task, seed: int) -> dict[str, np.ndarray]:
    """Puts a task where LIBERO's own placement, not a stored init state, has its objects.

    Returns:
        `start`, the flattened state, and `fixtures`, (n, 7) poses by sorted name: see `place_again`.

    Raises:
        SimulatorError: LIBERO found no placement.
    """
    simulator.reset(task, PLATFORM.first_reset(task))
    built = simulator._task
    drawn = np.random.get_state()
    np.random.seed(seed)
    # LIBERO adds the drawn pose of a fixture to where its places are: they have to be where the XML has them.
    for body in built.fixture_bodies.values():
        built.model.body_pos[body], built.model.body_quat[body] = 0, (1, 0, 0, 0)
    try:
        built._reset_env()
        state, fixtures = built.env.sim.get_state().flatten(), built.fixtures()
    finally:
        np.random.set_state(drawn)
    poses = [[*fixtures[name].position_m, *fixtures[name].quat_xyzw] for name in sorted(fixtures)]
    placed = {"start": state, "fixtures": np.array(poses).reshape(-1, 7)}
    place_again(simulator, task, placed)
    return placed


def place_again(simulator: LiberoSimulator, task: Task, placed: Mapping[str, np.ndarray]) -> None:
    """Puts a task where `place_freshly` put it, and settles."""
    simulator.reset(task, PLATFORM.first_reset(task))
    built = simulator._task
    fixtures = {
        name: Pose(tuple(pose[:3]), tuple(pose[3:]))
        for name, pose in zip(sorted(built.fixture_bodies), placed["fixtures"].tolist(), strict=True)
    }
    kept, built.init_states = built.init_states, placed["start"][None]
    try:
        simulator.reset(task, Reset(RELEASE_SEED, 0, PLATFORM.settle_steps, fixtures=fixtures))
    finally:
        built.init_states = kept
    for _ in range(PLATFORM.settle_steps):
        simulator.step(PLATFORM.no_op())


def demonstration(
    simulator: LiberoSimulator, task: Task, seed: int, perturbed: bool, after: Controller | None = None
) -> dict[str, np.ndarray] | None:
    """One successful episode of T steps, as arrays by LeRobot's names; None where the expert failed, or had
    nothing left to do.

    Args:
        simulator: with `obs_type="state"`.
        task: what to demonstrate.
        seed: of the placement and of the shaking.
        perturbed: disturb the executed actions for 20 to 100 steps from a step that is drawn.
        after: drives before the episode begins, and is then what is perturbed.
    """
    rng = np.random.default_rng(seed)
    placed = place_freshly(simulator, task, seed)
    first = int(rng.integers(0, 60))
    last = first + int(rng.integers(20, 100)) if perturbed else first
    lead = []
    if after is not None:
        for t in range(int(rng.integers(_TAKEN_OVER[0], int(_TAKEN_OVER[1] * task.horizon)))):
            action = after(t)
            lead.append(perturb_translations(action, rng) if first <= t < last else action)
            simulator.step(lead[-1])
            if simulator.succeeded():
                return None
        last = first  # the expert itself is not perturbed
    placed["lead"] = np.array(lead).reshape(-1, 7)
    found = expert_episode(
        simulator, task, lambda t, a: perturb_translations(a, rng) if first <= t < last else a
    )
    return None if found is None else found | placed


def expert_episode(
    simulator: LiberoSimulator,
    task: Task,
    executed: Callable[[int, np.ndarray], np.ndarray] = lambda _t, action: action,
) -> dict[str, np.ndarray] | None:
    """What the expert does from here, as arrays by LeRobot's names, and the actions as they were executed;
    None where it does not solve the task.

    Args:
        simulator: with `obs_type="state"`, in mid-rollout.
        task: of the rollout.
        executed: what becomes of the expert's action at a step.
    """
    expert, seen, actions, done, solved = LiberoExpert(LiberoScene(simulator)), [], [], [], []
    for t in range(task.horizon):
        seen.append(simulator.observe())
        actions.append(expert.act())
        done.append(executed(t, actions[-1]))
        simulator.step(done[-1])
        solved.append(simulator.succeeded())
        if sum(solved) == _STEPS_AFTER_SUCCESS:
            return _columns(seen, np.array(actions), np.array(solved)) | {"executed": np.array(done)}
    return None


def _columns(seen: Sequence[Any], actions: np.ndarray, solved: np.ndarray) -> dict[str, np.ndarray]:
    """What a policy's environment processors make of the observations."""
    from lerobot.envs.utils import preprocess_observation

    stacked = _stacked(seen)
    observation = PLATFORM.process_observation(preprocess_observation(stacked))
    columns = {
        name: observation[name].numpy() for name in ("observation.state", "observation.environment_state")
    }
    columns["action"] = np.clip(actions, -1, 1).astype(np.float32)
    columns["next.reward"] = solved[:, None].astype(np.float32)
    return columns


def _stacked(values: Sequence[Any]) -> Any:
    if isinstance(values[0], Mapping):
        return {key: _stacked([value[key] for value in values]) for key in values[0]}
    return np.stack(values)


def make_part(wanted: Wanted) -> str:
    """One task's episodes, in one file; says how it went."""
    began = time.monotonic()
    simulator = LiberoSimulator(obs_type="state")
    drivers = [LearnedPolicy(simulator, wanted.task, checkpoint) for checkpoint in wanted.after]
    first_seed = FIRST_SEED_AFTER if drivers else FIRST_SEED
    episodes, tried = [], 0
    while len(episodes) < wanted.episodes and tried < _GIVE_UP_AFTER * wanted.episodes:
        after = drivers[tried % len(drivers)] if drivers else None
        if after is not None:
            after.reset()
        try:
            episode = demonstration(simulator, wanted.task, first_seed + tried, len(episodes) % 2 == 1, after)
        except SimulatorError:
            episode = None
        tried += 1
        if episode is not None:
            episodes.append(episode)
    simulator.close()
    wanted.part.parent.mkdir(parents=True, exist_ok=True)
    unfinished = wanted.part.with_suffix(".unfinished.npz")
    names = set(episodes[0] if episodes else ()) - {"start", "fixtures", "lead"}
    leads = [e["lead"] for e in episodes]
    np.savez(
        unfinished,
        lengths=np.array([len(e["action"]) for e in episodes], dtype=np.int64),
        tried=np.array(tried),
        leads=np.array([len(lead) for lead in leads], dtype=np.int64),
        lead=np.concatenate([np.zeros((0, 7)), *leads]),
        **{name: np.array([e[name] for e in episodes]) for name in ("start", "fixtures")},
        **{name: np.concatenate([e[name] for e in episodes]) for name in names},
    )
    unfinished.rename(wanted.part)
    took = time.monotonic() - began
    return f"{PLATFORM.short_name(wanted.task)}: {len(episodes)} episodes from {tried} rollouts, {took:.0f} s"


def draw_part(wanted: Wanted) -> str:
    """A task's episodes once more, with pictures: replayed, and written as a LeRobotDataset of its own."""
    began = time.monotonic()
    simulator = LiberoSimulator(
        obs_type="pixels_agent_pos",
        render_quality="fast",
        observation_height=wanted.pictures,
        observation_width=wanted.pictures,
    )
    pictures: dict[str, list[np.ndarray]] = {camera: [] for camera in CAMERAS}
    with np.load(wanted.part) as part:
        first = 0
        # Parts of before `--after` have no lead.
        lead = np.split(part["lead"], np.cumsum(part["leads"])[:-1]) if "lead" in part.files else None
        placed, executed = {name: part[name] for name in ("start", "fixtures")}, part["executed"]
        for k, length in enumerate(part["lengths"]):
            place_again(simulator, wanted.task, {name: rows[k] for name, rows in placed.items()})
            for action in () if lead is None else lead[k]:
                simulator.step(action)
            for action in executed[first : first + length]:
                seen = simulator.observe()["pixels"]
                for camera in CAMERAS:
                    pictures[camera].append(seen[camera][::-1, ::-1])  # as LeRobot's processor turns them
                simulator.step(action)
            if not simulator.succeeded():
                raise SimulatorError(f"{wanted.part}: episode {k} does not end as it was recorded")
            first += length
    simulator.close()
    drawn = {f"observation.images.{camera}": np.stack(rows) for camera, rows in pictures.items()}
    write_dataset(wanted.drawn, [(wanted.task, wanted.part)], drawn)
    return f"{PLATFORM.short_name(wanted.task)}: {first} pictures twice, {time.monotonic() - began:.0f} s"


def write_dataset(
    root: Path, parts: Sequence[tuple[Task, Path]], pictures: Mapping[str, np.ndarray] | None = None
) -> int:
    """Writes parts as one LeRobotDataset, whole or not at all; returns its episodes.

    Its features are those of `--env.obs_type=state`, float32, and `next.reward`, 1 once the task is solved;
    with pictures, these in place of the privileged `observation.environment_state`.

    Args:
        root: must not exist.
        parts: a task and the file of its episodes, each.
        pictures: (N, H, W, 3) uint8 by name, of the N frames of the one part that there is then.
    """

    def episodes() -> Iterator[Episode]:
        for task, path in parts:
            with np.load(path) as part:
                columns = {name: part[name] for name in wanted} | dict(pictures or {})
                ends = np.cumsum(part["lengths"])
            for begin, end in zip([0, *ends[:-1]], ends, strict=True):
                rows = {name: column[begin:end] for name, column in columns.items()}
                yield Episode(task.instruction, rows)

    wanted = [name for name in (STATE, ENVIRONMENT, ACTION, REWARD) if name != ENVIRONMENT or not pictures]
    return write_episodes(root, episodes(), int(PLATFORM.control_hz), "panda")


def _join(root: Path, parts: Sequence[Path]) -> None:
    from lerobot.datasets.aggregate import aggregate_datasets

    with atomic_dir(root) as folder:
        aggregate_datasets([local_repo_id(p) for p in parts], local_repo_id(root), list(parts), folder)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder to write; must not exist")
    parser.add_argument("--episodes-per-task", type=int, default=16)
    parser.add_argument("--suites", nargs="+", help="of these alone")
    parser.add_argument("--pictures", type=int, default=0, help="side of the two cameras' pictures; 0: none")
    parser.add_argument("--parts", type=Path, help="folder of the finished tasks (OUT.parts)")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument(
        "--after", nargs="+", default=[], metavar="CHECKPOINT",
        help="policies that read the state, which drive first, in turn; the expert takes over",
    )  # fmt: skip
    args = parser.parse_args()
    if args.out.exists():
        parser.error(f"--out={args.out} exists already")
    tasks = tasks_of(args.suites)
    if not tasks:
        parser.error(f"--suites {args.suites}: there are {sorted({t.suite for t in PLATFORM.tasks()})}")
    folder = args.parts or args.out.with_name(f"{args.out.name}.parts")
    wanted = [
        Wanted(t, args.episodes_per_task, args.pictures, part_of(folder, t), tuple(args.after)) for t in tasks
    ]
    _in_processes(make_part, [w for w in wanted if not w.part.exists()], args.workers)
    solved = [w for w in wanted if len(np.load(w.part)["lengths"])]
    if args.pictures:
        _in_processes(draw_part, [w for w in solved if not w.drawn.exists()], args.workers)
        _join(args.out, [w.drawn for w in solved])
    else:
        write_dataset(args.out, [(w.task, w.part) for w in solved])
    print(f"demonstrations of {len(solved)} tasks in {args.out}", flush=True)


def _in_processes(make: Callable[[Wanted], str], wanted: Sequence[Wanted], workers: int) -> None:
    """The longest first, so that none is left alone at the end."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, spawn, max_tasks_per_child=1) as pool:
        ordered = sorted(wanted, key=lambda w: -w.task.horizon)
        for done in as_completed([pool.submit(make, w) for w in ordered]):
            print(done.result(), flush=True)


if __name__ == "__main__":
    main()
