"""`roborecover collect`: rollouts from initial states, judged, filmed, and written as a candidate dataset.

1. Everything that can be refused is refused before a simulator starts.
2. Rollouts, through the fast runner; each is a record and a journal's line once it has ended.
3. Each finished rollout is judged, from its record alone.
4. What is kept is replayed with pictures and written in parts.
5. The parts become the dataset, with a decision on every rollout.

Each of these goes on where it was stopped, and gives the same whatever the number of slots.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from lerobot_roborecover.build.collect_exclusions import check_rules
from lerobot_roborecover.build.collect_experts import check_expert
from lerobot_roborecover.build.collect_judge import Judging, Verdict, verdict
from lerobot_roborecover.build.collect_record import RecorderSettings, rollout_id
from lerobot_roborecover.build.collect_rollouts import Ended, RolloutBook, run_expert, run_policy, twin_of
from lerobot_roborecover.build.collect_server import SERVER
from lerobot_roborecover.build.collect_starts import (
    Starts,
    all_tasks,
    choose_tasks,
    make_units,
    settle_action,
)
from lerobot_roborecover.build.collect_write import Writing, read_about, write_collection
from lerobot_roborecover.build.funnel import FunnelRow, format_funnel, funnel, read_decisions
from lerobot_roborecover.build.rollout import PERTURBED_STEPS
from lerobot_roborecover.env.options import OptionError
from lerobot_roborecover.env.run import RunSpec
from lerobot_roborecover.env.slots import SlotPool
from lerobot_roborecover.evaluate.progress import ProgressLine
from lerobot_roborecover.evaluate.sizes import usable_cores
from lerobot_roborecover.scenario import Scenario, ScenarioError

SETTINGS_FILE = "collect.json"


@dataclass(frozen=True)
class CollectOptions:
    """What to collect."""

    platform: str
    """`libero`, `metaworld`, `robotwin` or `fake`."""
    out: Path
    """Folder of the candidate dataset; new."""
    starts: Starts
    tasks: tuple[str, ...]
    """Patterns; see `choose_tasks`."""
    policy: str = ""
    """Folder or Hub id of a checkpoint; or else:"""
    expert: str = ""
    """Name of a scripted driver."""
    name: str = ""
    """Recorded name of whoever drives; by default the checkpoint's identity, or the expert's name."""
    work: Path | None = None
    """Working folder; by default beside `out`. Another collection from the same rollouts shares it."""
    env: tuple[str, ...] = ()
    """`name=value` of the recovery env type: what the policy sees."""
    policy_options: tuple[str, ...] = ()
    """`name=value` of the policy's config."""
    rename_map: Mapping[str, str] = field(default_factory=dict)
    device: str | None = None
    perturb: bool = False
    perturbed_steps: int = PERTURBED_STEPS
    judging: Judging = field(default_factory=Judging)
    seed: int = 7
    """Of the perturbation, of the policy's noise, and of drivers that draw."""
    horizon: int = 0
    """Budget of each task in steps, of rollouts and of scenarios made from them; 0: the platform's."""
    film_every: int = 1
    """Steps from one picture to the next; the last one stands until then."""
    frames: int = 256
    """Side of the pictures in pixels; 0 films none."""
    slots: int = 0
    """Simulators at once; 0 takes one a core."""
    max_batch: int = 1
    """Slots that a policy is asked for at once. With 1 the result does not depend on their number."""
    part_size: int = 20
    watchdog_s: float = 600.0
    retry_errors: bool = False
    """Roll out again what broke in an earlier run."""
    description: str = ""
    license: str | None = None

    def check(self) -> None:
        """Checks what can be checked without a catalogue.

        Raises:
            OptionError, ScenarioError: naming the option, its value and what it may be.
        """
        if bool(self.policy) == bool(self.expert):
            raise OptionError(
                "who drives? Give either --policy.path=CHECKPOINT or --expert NAME"
                + (", not both" if self.policy else "")
            )
        if self.expert:
            check_expert(self.platform, self.expert)
        for name, low, high in (
            ("perturbed_steps", 1, 100_000), ("seed", 0, 2**32 - 1), ("slots", 0, 1024),
            ("horizon", 0, 10_000), ("max_batch", 1, 4096), ("part_size", 1, 10_000),
            ("watchdog_s", 1, 86_400),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                option = name.removesuffix("_s").replace("_", "-")
                raise OptionError(f"--{option}={getattr(self, name)}: must be from {low} to {high}")
        if not 1 <= self.film_every <= 1000:
            raise OptionError(f"--film-every={self.film_every}: 1 to 1000 steps")
        if self.frames and not 16 <= self.frames <= 2048:
            raise OptionError(f"--frames={self.frames}: none, or a side of 16 to 2048 pixels")
        if self.perturb and self.platform == "robotwin":
            raise OptionError(
                "--perturb: RoboTwin's actions are joint targets, or absolute poses that a planner turns "
                "into joint motion; they have no normalised translations to perturb (the paper perturbs "
                "LIBERO alone). Collect without it"
            )
        if self.judging.scene_touched_mm and not self.perturb:
            raise OptionError("--scene-touched: what a disturbance touched can be asked with --perturb alone")
        if self.judging.scene_touched_mm < 0:
            raise OptionError(f"--scene-touched={self.judging.scene_touched_mm:g}: millimetres, above 0")
        check_rules("--no-exclude", self.judging.skip)
        check_rules("--exclude-only", self.judging.only)


@dataclass(frozen=True)
class Collected:
    """What a collection came to."""

    out: Path | None
    """The dataset; None where nothing was kept."""
    rows: tuple[FunnelRow, ...]
    candidates: int
    """Episodes of the dataset, excluded ones among them."""
    already: bool = False
    """It had been finished before."""


def collect(options: CollectOptions, say: Callable[[str], None] = print) -> Collected:
    """Collects, or goes on collecting.

    Args:
        options: what.
        say: takes lines for people.

    Raises:
        OptionError, ScenarioError, SimulatorError: something cannot be used, or the folders hold another
            collection.
    """
    options.check()
    env, spec = _env(options)
    units = _units(options, getattr(env, "robotwin_root", None) or None)
    work = options.work or options.out.with_name(f"{options.out.name}.work")
    rolled, about = _settings(options, spec, units)
    finished = _finished(options.out, about)
    if finished is not None:
        say(f"{options.out} is finished already; nothing to do")
        return finished
    _claim(work, rolled)
    try:
        book = RolloutBook(work)
    except OSError as err:
        raise ScenarioError(f"{work} cannot be written: {err}") from err
    try:
        _roll_out(options, env, spec, units, book)
        verdicts = []
        for scenario in units:
            ended = book.find(rollout_id(scenario))
            assert ended is not None
            verdicts.append(verdict(scenario, ended, book, options.judging))
        dropped = [v.dropped for v in verdicts if v.dropped is not None]
        kept = [v for v in verdicts if v.dropped is None]
        if not kept:
            return Collected(None, tuple(funnel(dropped)), 0)
        _write(options, spec, work, book, kept, dropped, about)
    finally:
        book.close()
    shutil.rmtree(work / "parts", ignore_errors=True)
    return Collected(options.out, tuple(funnel(read_decisions(options.out))), len(kept))


def describe(collected: Collected) -> str:
    """The final table."""
    lines = [format_funnel(collected.rows)] if collected.rows else []
    if collected.out is not None:
        lines.append(f"\n{collected.candidates} candidates in {collected.out}")
    else:
        lines.append("\nno rollout was kept, so no dataset was written")
    return "\n".join(lines)


def plan(options: CollectOptions) -> list[Scenario]:
    """The rollouts that `collect` would run; starts nothing."""
    options.check()
    env, _ = _env(options)
    return _units(options, getattr(env, "robotwin_root", None) or None)


def _env(options: CollectOptions) -> tuple[Any, RunSpec]:
    """The recovery env config and its part of a run, checked."""
    from lerobot_roborecover.build.policy_trials import env_config

    given = [f"--{o.removeprefix('--')}" for o in options.env]
    if (
        options.expert
        and not any(o.startswith("--obs_type=") for o in given)
        and options.platform != "robotwin"
    ):
        given.append("--obs_type=state")
    env = env_config(options.platform, "none", given)
    if getattr(env, "control_mode", "relative") != "relative" and options.platform == "libero":
        raise OptionError(
            f"--env.control_mode={env.control_mode}: scenarios hold LIBERO's relative actions; only policies "
            "of relative actions can be collected from"
        )
    if getattr(env, "action_mode", "joint") == "ee" and env.control_mode != "absolute":
        raise OptionError(
            "--env.action_mode=ee: recorded poses are absolute; collect with --env.control_mode=absolute"
        )
    return env, env.run_spec()


def _units(options: CollectOptions, robotwin_root: str | None) -> list[Scenario]:
    tasks = choose_tasks(all_tasks(options.platform, robotwin_root), options.tasks)
    if options.horizon:
        tasks = [replace(task, horizon=options.horizon) for task in tasks]
    return make_units(
        tasks, options.starts, _driver(options), settle_action(options.platform), perturbed=options.perturb
    )


def _driver(options: CollectOptions) -> str:
    if options.name:
        return options.name
    if options.expert:
        return options.expert
    from lerobot_roborecover.env.command_line import policy_identity

    return policy_identity(options.policy)


def _settings(
    options: CollectOptions, spec: RunSpec, units: Sequence[Scenario]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """What decides the rollouts, and what decides the dataset."""
    from lerobot_roborecover.env.command_line import policy_identity

    rolled = {
        "platform": options.platform,
        "driver": _driver(options),
        "policy": policy_identity(options.policy) if options.policy else "",
        "expert": options.expert,
        "policy options": sorted(options.policy_options),
        "env": {
            k: v for k, v in spec.decisive.items() if options.policy or k in ("control_mode", "action_mode")
        },
        "rename map": dict(options.rename_map),
        "seed": options.seed,
        "max batch": options.max_batch if options.policy else 1,
        "perturb": options.perturb,
        "perturbed steps": options.perturbed_steps if options.perturb else 0,
        "horizon": options.horizon,
        "reset seed": options.starts.reset_seed if options.platform == "libero" else None,
    }
    judging = asdict(options.judging)
    rolled = json.loads(json.dumps(rolled, default=str))
    starts = {k: v for k, v in asdict(options.starts).items() if k != "reset_seed"}
    about = {
        "rollouts": rolled,
        "starts": {"tasks": list(options.tasks), **starts, "count": len(units)},
        "judging": judging,
        "frames": options.frames,
        "film_every": options.film_every,
    }
    return rolled, json.loads(json.dumps(about))


def _finished(out: Path, about: Mapping[str, Any]) -> Collected | None:
    """The finished collection in `out`, if it is this one.

    Raises:
        ScenarioError: it is another, or something else is there.
    """
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    found = read_about(out) if out.is_dir() else None
    if found is None:
        raise ScenarioError(f"{out} holds something other than a collection; give another --out")
    differences = _differences(
        {k: found.get(k) for k in about}, dict(about), ("rollouts", "starts", "judging")
    )
    if differences:
        raise ScenarioError(
            f"{out} holds a collection with other options ({'; '.join(differences)}). Give another --out; "
            "with --work naming the same working folder, rollouts that it has are not run again"
        )
    decisions = read_decisions(out)
    from lerobot_roborecover.build.candidates import read_candidates

    return Collected(out, tuple(funnel(decisions)), len(read_candidates(out)), already=True)


def _claim(work: Path, rolled: Mapping[str, Any]) -> None:
    """Makes the working folder this collection's.

    Raises:
        ScenarioError: its rollouts are of other options, or it cannot be written.
    """
    path = work / SETTINGS_FILE
    try:
        work.mkdir(parents=True, exist_ok=True)
        if path.is_file():
            found = json.loads(path.read_bytes())
            differences = _differences(found, dict(rolled), ())
            if differences:
                raise ScenarioError(
                    f"{work} holds rollouts with other options ({'; '.join(differences)}). Give another "
                    "--out, or another --work"
                )
            return
        temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
        temporary.write_text(json.dumps(rolled, indent=2) + "\n", encoding="utf-8")
        os.replace(temporary, path)
    except (OSError, ValueError) as err:
        if isinstance(err, ScenarioError):
            raise
        raise ScenarioError(
            f"the working folder {work} cannot be used: {err}. Make room, or give another --work"
        ) from err


def _differences(found: Any, wanted: dict[str, Any], nested: Sequence[str]) -> list[str]:
    lines = []
    for key, value in wanted.items():
        there = found.get(key) if isinstance(found, dict) else None
        if key in nested:
            lines += _differences(there, value, ())
        elif there != value:
            lines.append(f"{key} {_short(there)}, now {_short(value)}")
    return lines


def _short(value: Any) -> str:
    text = json.dumps(value) if not isinstance(value, str) else value or "none"
    return text if len(text) <= 60 else f"{text[:57]}..."


class _Count:
    """How far something is, as `ProgressLine` asks."""

    half_width = None

    def __init__(self, done: int, total: int):
        self.done, self.total, self.solved = done, total, 0
        self.ended = 0

    @property
    def rate(self) -> float | None:
        """Share of successes among those that ended in this run."""
        return self.solved / self.ended if self.ended else None


def _slot_count(options: CollectOptions) -> int:
    return options.slots or usable_cores()


def _roll_out(
    options: CollectOptions, env: Any, spec: RunSpec, units: Sequence[Scenario], book: RolloutBook
) -> None:
    """Runs what the book does not hold yet."""
    passes = [(False, list(units))]
    if options.judging.scene_touched_mm:
        passes.append((True, [twin_of(s) for s in units]))
    todo = [
        (
            twins,
            [s for s in wanted if book.find(rollout_id(s, twins), retry_errors=options.retry_errors) is None],
        )
        for twins, wanted in passes
    ]
    total, left = sum(len(w) for _, w in passes), sum(len(t) for _, t in todo)
    count, line = _Count(total - left, total), ProgressLine("rollouts", detailed=True, unit="rollouts")
    line.show(count)
    if not left:
        return

    def on_end(ended: Ended) -> None:
        book.add(ended)
        count.done += 1
        count.ended += 1
        count.solved += ended.outcome == "success"
        line.show(count)

    settings = asdict(
        RecorderSettings(str(book.records.resolve()), options.seed, options.expert, options.perturbed_steps)
    )
    slot = replace(spec.slot, server=SERVER, settings=settings, environment=_drawing(options, env))
    pool = SlotPool(slot, workers=True, timeout_s=options.watchdog_s)
    pool.acquire()
    try:
        host = _load_host(options, env) if options.policy else None
        for twins, wanted in todo:
            if options.expert:
                run_expert(wanted, pool, _slot_count(options), on_end, twins=twins)
            else:
                run_policy(wanted, pool, _slot_count(options), host, options.seed, on_end, twins=twins)
        line.show(count, final=True)
    finally:
        pool.release()


def _drawing(options: CollectOptions, env: Any, *, films: bool = False) -> Mapping[str, str | None]:
    """Where the workers draw, if they do."""
    if not films and getattr(env, "obs_type", "state") == "state":
        return {}
    from lerobot_roborecover.env.render_device import egl_devices, render_environment

    return render_environment("auto", options.device or "cpu", egl_devices())


def _load_host(options: CollectOptions, env: Any) -> Any:
    from lerobot.configs.policies import PreTrainedConfig

    from lerobot_roborecover.env.intervention_options import POLICY_TYPE
    from lerobot_roborecover.evaluate.runner import load_host
    from lerobot_roborecover.interventions.monitor.files import CONFIG_FILE, find_file

    find_file(options.policy, CONFIG_FILE)
    overrides = [f"--{o.removeprefix('--')}" for o in options.policy_options]
    overrides += [f"--device={options.device}"] if options.device else []
    config = PreTrainedConfig.from_pretrained(options.policy, cli_overrides=overrides)
    config.pretrained_path = Path(options.policy)
    if config.type == POLICY_TYPE:
        raise OptionError(
            f"--policy.path={options.policy}: an intervention goes back in time and cannot be replayed as "
            "one rollout; collect from its base policy"
        )
    runner = SimpleNamespace(max_batch=options.max_batch)
    return load_host(
        SimpleNamespace(
            policy=config, env=env, rename_map=dict(options.rename_map), seed=options.seed, runner=runner
        )
    )


def _write(
    options: CollectOptions,
    spec: RunSpec,
    work: Path,
    book: RolloutBook,
    kept: Sequence[Verdict],
    dropped: Sequence[Any],
    about: Mapping[str, Any],
) -> None:
    drawing = _drawing(options, None, films=True) if options.frames else {}
    slot = replace(
        spec.slot, server=SERVER, settings={}, environment=drawing, options=_film_options(options, spec),
        control_mode=None,
    )  # fmt: skip
    pool = SlotPool(slot, workers=True, timeout_s=options.watchdog_s)
    pool.acquire()
    try:
        (one,) = pool.slots(1)
        one.send("fingerprint")
        versions = one.receive()
        if not isinstance(versions, dict):
            raise ScenarioError(f"no simulator could be made to film with: {versions.message}")
        films = {k: v for k, v in slot.options.items() if k not in ("assets_dir", "robotwin_root")}
        writing = Writing(
            book.records, work / "parts", pool, _slot_count(options), round(pool.spaces()["hz"]), versions,
            f"{options.frames}/{options.film_every}", options.film_every, films, options.part_size,
            options.description, options.license,
        )  # fmt: skip
        count, line = _Count(0, len(kept)), ProgressLine("writing", detailed=True, unit="candidates")

        def on_film(done: int) -> None:
            count.done = done
            line.show(count, final=done == len(kept))

        write_collection(options.out, kept, dropped, writing, about, on_film)
    except OSError as err:
        raise ScenarioError(
            f"{options.out} could not be written: {err}. Nothing that was finished is lost: make room, and "
            "run the same command again"
        ) from err
    finally:
        pool.release()


def _film_options(options: CollectOptions, spec: RunSpec) -> dict[str, Any]:
    """Options of the simulator that films: the policy's own, but for what is seen."""
    changed: dict[str, Any] = {"obs_type": "pixels_agent_pos" if options.frames else "state"}
    if options.frames and options.platform in ("libero", "metaworld"):
        changed |= {"observation_height": options.frames, "observation_width": options.frames}
    if options.frames and options.platform == "fake":
        changed["observation_size"] = options.frames
    return {**spec.slot.options, **changed}
