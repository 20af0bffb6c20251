"""The two long parts of a collection, with their simulators: rolling out, and filming what is kept."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

from lerobot_roborecover.curation.collect.judge import RolloutVerdict
from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.curation.collect.record import RecorderSettings
from lerobot_roborecover.curation.collect.rollouts import Ended, RolloutBook, run_expert, run_policy
from lerobot_roborecover.curation.collect.server import SERVER
from lerobot_roborecover.curation.collect.starts import Planned
from lerobot_roborecover.curation.collect.write import Writing, write_collection
from lerobot_roborecover.curation.film import Film
from lerobot_roborecover.env.options import OptionError
from lerobot_roborecover.env.run import PlatformPart
from lerobot_roborecover.platforms import platform_named
from lerobot_roborecover.scenario import ScenarioError
from lerobot_roborecover.trials.progress import ProgressLine
from lerobot_roborecover.trials.sizes import usable_cores
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


def _slot_count(options: CollectOptions) -> int:
    return options.slots or usable_cores()


def roll_out(
    options: CollectOptions, env: Any, spec: PlatformPart, units: Sequence[Planned], book: RolloutBook
) -> None:
    """Runs what the book does not hold yet."""
    passes = [list(units)]
    if options.judging.scene_touched_mm:
        passes.append([replace(u, twin=True) for u in units])
    todo = [
        [u for u in wanted if book.find(u.record_name, retry_errors=options.retry_errors) is None]
        for wanted in passes
    ]
    total, left = sum(map(len, passes)), sum(map(len, todo))
    count, line = Count(total - left, total), ProgressLine("rollouts", detailed=True, unit="rollouts")
    line.show(count)
    if not left:
        return

    def on_end(ended: Ended, record: bytes) -> None:
        book.add(ended, record)
        count.done += 1
        count.ended += 1
        count.solved += ended.outcome == "success"
        line.show(count)

    settings = asdict(RecorderSettings(options.seed, options.expert, options.perturbed_steps))
    slot = replace(spec.slot, server=SERVER, settings=settings, environment=_drawing(options, env))
    pool = SlotPool(slot, workers=True, timeout_s=options.watchdog_s)
    pool.acquire()
    try:
        host = _load_host(options, env) if options.policy else None
        for wanted in todo:
            if options.expert:
                run_expert(wanted, pool, _slot_count(options), on_end)
            else:
                run_policy(wanted, pool, _slot_count(options), host, options.seed, on_end)
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
    from lerobot_roborecover.env.intervention_options import POLICY_TYPE
    from lerobot_roborecover.trials import load

    config = load.policy_config(options.policy, options.policy_options, options.device)
    if config.type == POLICY_TYPE:
        raise OptionError(
            f"--policy.path={options.policy}: an intervention goes back in time and cannot be replayed as "
            "one rollout; collect from its base policy"
        )
    spec = load.HostSpec(config, env, options.rename_map or {}, options.seed, options.max_batch)
    return load.load_host(spec)


def film_and_write(
    options: CollectOptions,
    spec: PlatformPart,
    book: RolloutBook,
    kept: Sequence[RolloutVerdict],
    dropped: Sequence[Any],
    about: Mapping[str, Any],
) -> None:
    """Films what is kept, and writes the dataset.

    Args:
        options: of the collection.
        spec: the env type's part of a run.
        book: of the rollouts.
        kept: candidates, in the order of their episodes.
        dropped: decisions on all others.
        about: content of `meta/roborecover/collect.json`.

    Raises:
        ScenarioError: nothing could be filmed, or the disk is full.
    """
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
            raise ScenarioError(f"no simulator could be made to film with: {failed(versions)}")
        writing = Writing(
            records=book.records,
            parts=book.work / PARTS_FOLDER,
            pool=pool,
            slots=_slot_count(options),
            fps=round(pool.spaces()["hz"]),
            versions=versions,
            frames=f"{options.frames}/{options.film_every}",
            film=Film(options.film_every, slot.options),
            part_size=options.part_size,
            description=options.description,
            license=options.license,
        )
        count, line = Count(0, len(kept)), ProgressLine("writing", detailed=True, unit="candidates")

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


def _film_options(options: CollectOptions, spec: PlatformPart) -> dict[str, Any]:
    """Options of the simulator that films: the policy's own, but for what is seen."""
    return {**spec.slot.options, **platform_named(options.platform).picture_options(options.frames)}
