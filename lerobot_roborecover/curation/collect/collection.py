"""`curate collect`: rollouts from initial states, judged, rendered, and written as a candidate dataset.

1. Everything that can be refused is refused before a simulator starts.
2. Rollouts, through the fast runner; each is a record and a journal's line once it has ended.
3. Each finished rollout is judged, from its record alone.
4. What is kept is written in parts, replayed where pictures are wanted.
5. The parts become the dataset, with a decision on every rollout.

Each of these goes on where it was stopped, and gives the same whatever the number of slots.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lerobot_roborecover.curation.candidates import read_candidates
from lerobot_roborecover.curation.collect.judge import verdict
from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.curation.collect.rollouts import RolloutJournal
from lerobot_roborecover.curation.collect.run import PARTS_FOLDER, render_and_write, roll_out
from lerobot_roborecover.curation.collect.settings import claim, controller_of, differences, settings_of
from lerobot_roborecover.curation.collect.starts import RolloutSpec, make_units
from lerobot_roborecover.curation.collect.write import read_about
from lerobot_roborecover.curation.funnel import StageCounts, attrition_table, count_stages, read_decisions
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.session import SimulatorSpec
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.platforms.catalog import choose_tasks
from lerobot_roborecover.scenario import ScenarioError, Task
from lerobot_roborecover.utils.text import next_command, pluralize

if TYPE_CHECKING:
    from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig


@dataclass(frozen=True)
class Collected:
    out: Path | None
    """The dataset; None where nothing was kept."""
    rows: tuple[StageCounts, ...]
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
        book = RolloutJournal(work)
    except OSError as err:
        raise ScenarioError(f"{work} cannot be written: {err}") from err
    try:
        roll_out(options, env, spec, units, book)
        verdicts = []
        for unit in units:
            ended = book.find(unit.record_name)
            assert ended is not None  # every rollout has run
            verdicts.append(verdict(unit, ended, book, options.judging))
        dropped = [v.dropped for v in verdicts if v.dropped is not None]
        kept = [v for v in verdicts if v.dropped is None]
        if not kept:
            return Collected(None, tuple(count_stages(dropped)), 0)
        render_and_write(options, spec, book, kept, dropped, about)
    finally:
        book.close()
    shutil.rmtree(work / PARTS_FOLDER, ignore_errors=True)
    return _collected(options.out)


def describe(collected: Collected) -> str:
    """The final table, and the command that follows."""
    lines = [attrition_table(collected.rows)] if collected.rows else []
    if collected.out is not None:
        excluded = collected.candidates - collected.rows[0].kept if collected.rows else 0
        line = f"\n{pluralize(collected.candidates - excluded, 'candidate')} in {collected.out}"
        lines.append(line + (f"; {excluded} beside them that a rule leaves out" if excluded else ""))
        lines.append(next_command(["curate", "annotate", str(collected.out), "--annotator", "NAME"]))
    else:
        lines.append("\nno rollout was kept, so no dataset was written")
    return "\n".join(lines)


def plan(options: CollectOptions, say: Callable[[str], None] = print) -> list[RolloutSpec]:
    """The rollouts that `collect` would run; starts nothing. `say` takes lines for people."""
    options.check()
    env, _ = _env(options)
    return _units(options, env, say)


def _env(options: CollectOptions) -> tuple[RecoveryEnvConfig, SimulatorSpec]:
    """The recovery env config and its part of a run, checked."""
    from lerobot_roborecover.curation.policy_trials import env_config

    given = [f"--{o.removeprefix('--')}" for o in options.env]
    if options.expert and not any(o.startswith("--obs_type=") for o in given):
        given.append("--obs_type=state")
    env = env_config(options.platform, "none", given)
    recorded = platform_named(options.platform).records_control_mode
    mode = getattr(env, "control_mode", None)
    if recorded is not None and mode != recorded:
        raise OptionError(
            f"--env.control_mode={mode}: scenarios hold {recorded} actions; only policies "
            f"of {recorded} actions can be collected from"
        )
    if getattr(env, "action_mode", "joint") == "ee" and mode != "absolute":
        raise OptionError(
            "--env.action_mode=ee: recorded poses are absolute; collect with --env.control_mode=absolute"
        )
    return env, env.run_spec()


def _units(options: CollectOptions, env: Any, say: Callable[[str], None]) -> list[RolloutSpec]:
    own = platform_named(options.platform)
    tasks = choose_tasks(own.tasks(env.gym_kwargs), options.tasks)
    if options.expert:
        tasks = _drivable(options.expert, tasks, say)
    if options.horizon:
        tasks = [replace(task, horizon=options.horizon) for task in tasks]
    return make_units(tasks, options.starts, controller_of(options), own.no_op(), perturbed=options.perturb)


def _drivable(expert: str, tasks: Sequence[Task], say: Callable[[str], None]) -> list[Task]:
    """Tasks that the scripted controller can try; says which are left out, and why.

    Raises:
        ScenarioError: there is none.
    """
    why_not = {task: platform_named(task.platform).unsupported_reason(task) for task in tasks}
    able = [task for task, why in why_not.items() if not why]
    left_out = [f"{task.suite}/{task.name} ({why})" for task, why in why_not.items() if why]
    if not able:
        raise ScenarioError(
            f"--expert {expert} can do none of these tasks: {'; '.join(left_out)}. Choose others with "
            "--task, or collect from a policy with --policy.path=CHECKPOINT"
        )
    if left_out:
        say(f"left out, because {expert} cannot do them: {'; '.join(left_out)}")
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
    return Collected(out, tuple(count_stages(read_decisions(out))), len(read_candidates(out)), already)
