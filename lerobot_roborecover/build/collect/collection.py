"""`roborecover collect`: rollouts from initial states, judged, filmed, and written as a candidate dataset.

1. Everything that can be refused is refused before a simulator starts.
2. Rollouts, through the fast runner; each is a record and a journal's line once it has ended.
3. Each finished rollout is judged, from its record alone.
4. What is kept is replayed with pictures and written in parts.
5. The parts become the dataset, with a decision on every rollout.

Each of these goes on where it was stopped, and gives the same whatever the number of slots.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lerobot_roborecover.build.candidates import read_candidates
from lerobot_roborecover.build.collect.experts import cannot_drive
from lerobot_roborecover.build.collect.judge import verdict
from lerobot_roborecover.build.collect.options import CollectOptions
from lerobot_roborecover.build.collect.record import rollout_id
from lerobot_roborecover.build.collect.rollouts import RolloutBook
from lerobot_roborecover.build.collect.run import PARTS_FOLDER, film_and_write, roll_out
from lerobot_roborecover.build.collect.settings import claim, differences, driver_of, settings_of
from lerobot_roborecover.build.collect.starts import (
    all_tasks,
    choose_tasks,
    make_units,
    settle_action,
)
from lerobot_roborecover.build.collect.write import read_about
from lerobot_roborecover.build.funnel import FunnelRow, format_funnel, funnel, read_decisions
from lerobot_roborecover.env.options import OptionError
from lerobot_roborecover.env.run import RunSpec
from lerobot_roborecover.scenario import Scenario, ScenarioError, Task


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
    units = _units(options, env, say)
    work = options.work or options.out.with_name(f"{options.out.name}.work")
    rolled, about = settings_of(options, spec, units)
    finished = _finished(options.out, about)
    if finished is not None:
        say(f"{options.out} is finished already; nothing to do")
        return finished
    claim(work, rolled)
    try:
        book = RolloutBook(work)
    except OSError as err:
        raise ScenarioError(f"{work} cannot be written: {err}") from err
    try:
        roll_out(options, env, spec, units, book)
        verdicts = []
        for scenario in units:
            ended = book.find(rollout_id(scenario))
            assert ended is not None  # every rollout has run
            verdicts.append(verdict(scenario, ended, book, options.judging))
        dropped = [v.dropped for v in verdicts if v.dropped is not None]
        kept = [v for v in verdicts if v.dropped is None]
        if not kept:
            return Collected(None, tuple(funnel(dropped)), 0)
        film_and_write(options, spec, book, kept, dropped, about)
    finally:
        book.close()
    shutil.rmtree(work / PARTS_FOLDER, ignore_errors=True)
    return _collected(options.out)


def describe(collected: Collected) -> str:
    """The final table."""
    lines = [format_funnel(collected.rows)] if collected.rows else []
    if collected.out is not None:
        lines.append(f"\n{collected.candidates} candidates in {collected.out}")
    else:
        lines.append("\nno rollout was kept, so no dataset was written")
    return "\n".join(lines)


def plan(options: CollectOptions, say: Callable[[str], None] = print) -> list[Scenario]:
    """The rollouts that `collect` would run; starts nothing. `say` takes lines for people."""
    options.check()
    env, _ = _env(options)
    return _units(options, env, say)


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


def _units(options: CollectOptions, env: Any, say: Callable[[str], None]) -> list[Scenario]:
    root = getattr(env, "robotwin_root", None) or None
    tasks = choose_tasks(all_tasks(options.platform, root), options.tasks)
    if options.expert:
        tasks = _drivable(options.expert, tasks, say)
    if options.horizon:
        tasks = [replace(task, horizon=options.horizon) for task in tasks]
    return make_units(
        tasks, options.starts, driver_of(options), settle_action(options.platform), perturbed=options.perturb
    )


def _drivable(expert: str, tasks: Sequence[Task], say: Callable[[str], None]) -> list[Task]:
    """Tasks that the scripted driver can try; says which are left out, and why.

    Raises:
        ScenarioError: there is none.
    """
    why_not = {task: cannot_drive(task) for task in tasks}
    able = [task for task, why in why_not.items() if not why]
    left_out = [f"{task.suite}/{task.name} ({why})" for task, why in why_not.items() if why]
    if not able:
        raise ScenarioError(
            f"--expert {expert} can drive none of these tasks: {'; '.join(left_out)}. Choose others with "
            "--task, or collect from a policy with --policy.path=CHECKPOINT"
        )
    if left_out:
        say(f"left out, because {expert} cannot drive them: {'; '.join(left_out)}")
    return able


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
    changed = differences({k: found.get(k) for k in about}, dict(about), ("rollouts", "starts", "judging"))
    if changed:
        raise ScenarioError(
            f"{out} holds a collection with other options ({'; '.join(changed)}). Give another --out; "
            "with --work naming the same working folder, rollouts that it has are not run again"
        )
    return _collected(out, already=True)


def _collected(out: Path, *, already: bool = False) -> Collected:
    return Collected(out, tuple(funnel(read_decisions(out))), len(read_candidates(out)), already)
