"""The two long parts of a collection, with their simulators: rolling out, and rendering what is kept."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from typing import Any

from lerobot_roborecover.curation.collect.judge import RolloutVerdict
from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.curation.collect.record import RecorderSettings
from lerobot_roborecover.curation.collect.rollouts import (
    OnEnd,
    RolloutJournal,
    RolloutOutcome,
    run_expert,
    run_policy,
)
from lerobot_roborecover.curation.collect.server import SERVER
from lerobot_roborecover.curation.collect.starts import RolloutSpec
from lerobot_roborecover.curation.collect.write import WriterConfig, write_collection
from lerobot_roborecover.curation.video_settings import VideoSettings
from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.evaluation.progress import ProgressLine
from lerobot_roborecover.evaluation.session import SimulatorSpec
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import Outcome, ScenarioError
from lerobot_roborecover.workers.backend import WorkerStartup
from lerobot_roborecover.workers.capacity import available_gb, default_slots, usable_cores
from lerobot_roborecover.workers.dispatch import failed
from lerobot_roborecover.workers.slots import SlotPool

PARTS_FOLDER = "parts"


class Count:
    """How far something is, as `ProgressLine` asks."""

    interval = None
    note = ""

    def __init__(self, done: int, total: int):
        self.done, self.total, self.solved = done, total, 0
        self.ended = 0

    @property
    def rate(self) -> float | None:
        """Share of successes among those that ended in this run."""
        return self.solved / self.ended if self.ended else None


def roll_out(
    options: CollectOptions, env: Any, spec: SimulatorSpec, units: Sequence[RolloutSpec], book: RolloutJournal
) -> None:
    """Runs what the book does not hold yet; the undisturbed twins last, of those that failed: what succeeded
    is dropped whatever its twin did."""
    wants_twins = bool(options.judging.min_displacement_mm)

    def lacking(wanted: Iterable[RolloutSpec]) -> list[RolloutSpec]:
        return [u for u in wanted if book.find(u.record_name, retry_errors=options.retry_errors) is None]

    def twins() -> list[RolloutSpec]:
        return [replace(u, twin=True) for u in units if wants_twins and not _solved(book, u)]

    def passes() -> Iterator[list[RolloutSpec]]:
        yield lacking(units)
        yield lacking(twins())

    # Twins of those that are still to be run are counted until they succeed.
    left, total = len(lacking(units)) + len(lacking(twins())), len(units) + len(twins())
    progress, line = Count(total - left, total), ProgressLine("rollouts", detailed=True, unit="rollouts")
    line.show(progress)
    if not left:
        return
    disturbed = {u.record_name for u in units}

    def on_end(ended: RolloutOutcome, record: bytes) -> None:
        solved = ended.outcome == Outcome.SUCCESS
        book.add(ended, record)
        progress.done += 1
        progress.ended += 1
        progress.solved += solved
        if wants_twins and solved and ended.rollout in disturbed:
            progress.total -= 1
        line.show(progress)

    every = options.frame_stride if _sees_what_is_kept(options, spec) else 0
    settings = asdict(RecorderSettings(options.seed, options.expert, options.perturb_steps, every))
    slot = replace(spec.slot, server=SERVER, settings=settings)
    draws = getattr(env, "obs_type", "state") != "state"
    pool = SlotPool(slot, workers=True, timeout_s=options.watchdog_s)
    pool.acquire()
    try:
        if options.expert:
            count = _settle(pool, options, draws=draws)
            for wanted in passes():
                run_expert(wanted, pool, count, on_end)
        else:
            _run_policy(options, env, passes(), pool, draws, units[0].driver, left, on_end)
        line.show(progress, final=True)
    finally:
        pool.release()


def _solved(book: RolloutJournal, unit: RolloutSpec) -> bool:
    ended = book.find(unit.record_name)
    return ended is not None and ended.outcome == Outcome.SUCCESS


def _settle(pool: SlotPool, options: CollectOptions, *, draws: bool) -> int:
    """Has the pool's slots made where the options say, drawing on that machine's own device; how many there
    may be."""
    startup = WorkerStartup()
    if draws:
        from lerobot_roborecover.workers.render_device import egl_devices, node_drawing, render_environment

        startup = WorkerStartup(partial(node_drawing, "auto"))
        if not options.workplace.on_cluster:
            pool.configure(environment=render_environment("auto", options.device or "cpu", egl_devices()))
    return options.workplace.allocate_workers(
        pool, options.num_workers, default_slots("cpu", usable_cores(), available_gb()), startup
    )


def _run_policy(
    options: CollectOptions,
    env: Any,
    passes: Iterable[Sequence[RolloutSpec]],
    pool: SlotPool,
    draws: bool,
    driver: str,
    most: int,
    on_end: OnEnd,
) -> None:
    from lerobot_roborecover.evaluation import loading
    from lerobot_roborecover.evaluation.launch import EngineConfig
    from lerobot_roborecover.policies.interventions.options import POLICY_TYPE

    config = loading.policy_config(options.policy, options.policy_options, options.device)
    if config.type == POLICY_TYPE:
        raise OptionError(
            f"--policy.path={options.policy}: an intervention goes back in time and cannot be replayed as "
            "one rollout; collect from its base policy"
        )
    spec = loading.HostSpec(config, env, options.rename_map or {}, options.seed, options.max_batch)
    places = EngineConfig(options.workplace, options.num_workers, options.replicas, str(config.device), draws)
    host = partial(loading.load_host, spec)
    run_policy(passes, pool, host, places, driver=driver, seed=options.seed, most=most, on_end=on_end)


def render_and_write(
    options: CollectOptions,
    spec: SimulatorSpec,
    book: RolloutJournal,
    kept: Sequence[RolloutVerdict],
    dropped: Sequence[Any],
    about: Mapping[str, Any],
) -> None:
    """Renders what is kept, and writes the dataset.

    Args:
        options: of the collection.
        spec: the env type's part of a run.
        book: of the rollouts.
        kept: candidates, in the order of their episodes.
        dropped: decisions on all others.
        about: content of `meta/roborecover/collect.json`.

    Raises:
        ScenarioError: nothing could be rendered, or the disk is full.
    """
    slot = replace(
        spec.slot, server=SERVER, settings={}, options=_render_options(options, spec), control_mode=None
    )
    pool = SlotPool(slot, workers=True, timeout_s=options.watchdog_s)
    pool.acquire()
    try:
        later = replace(options, workplace=replace(options.workplace, fits=True))
        slots = _settle(pool, later, draws=bool(options.frames))
        versions = pool.ask("fingerprint")
        if not isinstance(versions, dict):
            raise ScenarioError(f"no simulator could be made to render with: {failed(versions)}")
        writing = WriterConfig(
            records=book.records,
            parts=book.work / PARTS_FOLDER,
            pool=pool,
            slots=slots,
            fps=round(pool.spaces()["hz"]),
            versions=versions,
            frames=f"{options.frames}/{options.frame_stride}",
            video=VideoSettings(options.frame_stride, slot.options),
            replay=not _sees_what_is_kept(options, spec),
            part_size=options.part_size,
            description=options.description,
            license=options.license,
        )
        count, line = Count(0, len(kept)), ProgressLine("writing", detailed=True, unit="candidates")

        def on_rendered(done: int) -> None:
            count.done = done
            line.show(count, final=done == len(kept))

        write_collection(options.out, kept, dropped, writing, about, on_rendered)
    except OSError as err:
        raise ScenarioError(
            f"{options.out} could not be written: {err}. Nothing that was finished is lost: make room, and "
            "run the same command again"
        ) from err
    finally:
        pool.release()


def _sees_what_is_kept(options: CollectOptions, spec: SimulatorSpec) -> bool:
    """Whether the simulator that rolls out observes what the dataset is to hold, and no pictures: then it is
    recorded on the way, and nothing has to be replayed for it."""
    return not options.frames and _render_options(options, spec) == spec.slot.options


def _render_options(options: CollectOptions, spec: SimulatorSpec) -> dict[str, Any]:
    """Options of the simulator that renders: the policy's own, but for what is seen."""
    return {**spec.slot.options, **platform_named(options.platform).picture_options(options.frames)}
