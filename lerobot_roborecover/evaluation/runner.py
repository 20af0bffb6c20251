"""`roborecover eval`: LeRobot's own configuration and loaders, an engine, and a table at the end."""

import json
import logging
import os
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from lerobot.configs import PreTrainedConfig, parser
from lerobot.configs.default import EvalConfig
from lerobot.configs.eval import EvalPipelineConfig
from lerobot.utils.utils import init_logging

from lerobot_roborecover.analysis.summary import format_table, summarise
from lerobot_roborecover.datasets import ScenarioSet
from lerobot_roborecover.errors import OptionError, check_seed
from lerobot_roborecover.evaluation.arms import NESTED
from lerobot_roborecover.evaluation.env_configs import RecoveryEnvConfig
from lerobot_roborecover.evaluation.eval_info import check_eval_info, eval_info
from lerobot_roborecover.evaluation.launch import EngineConfig, RunResult, run_work_items
from lerobot_roborecover.evaluation.loading import HostSpec, load_host, remedy_of
from lerobot_roborecover.evaluation.options import ALIASES, long_names
from lerobot_roborecover.evaluation.progress import ProgressLine, RunProgress
from lerobot_roborecover.evaluation.sequential import open_watch
from lerobot_roborecover.evaluation.session import EvalSession, create_session
from lerobot_roborecover.evaluation.videos import VideoRecorder, default_videos, video_trial
from lerobot_roborecover.evaluation.work_items import OrderedQueue, WorkQueue, units_of
from lerobot_roborecover.logs.extent import missing
from lerobot_roborecover.logs.row import TrialRow
from lerobot_roborecover.logs.trial_log import check_retry
from lerobot_roborecover.policies.checkpoint import check_checkpoint
from lerobot_roborecover.policies.command_line import run_with_arguments
from lerobot_roborecover.policies.metadata import policy_metadata
from lerobot_roborecover.scenario import Start
from lerobot_roborecover.utils.atomic_io import atomic_write
from lerobot_roborecover.utils.options import move_old_fields
from lerobot_roborecover.utils.signals import StopCondition
from lerobot_roborecover.utils.text import next_command, pluralize
from lerobot_roborecover.workers.backend import Backend

logger = logging.getLogger(__name__)
_BESIDE = "-initial"
"""What the folder of the initial trials is called, beside that of a recovery run."""


@dataclass
class RunnerOptions:
    """Options of `--runner.*`."""

    engine: str = "local"
    """`local`: this machine; `ray`: a Ray cluster."""
    slots: int = 0
    """Simulators at once; 0 takes one per core, and two per core under a policy on a GPU as far as memory
    allows."""
    max_batch: int = 64
    """Slots the policy is asked for at once, at most."""
    batch_delay_ms: float = 10.0
    """How long a waiting trial waits for others to join its batch."""
    limit_seconds: float = 0.0
    """Stop cleanly after this long; 0 does not. The same command goes on where it stopped."""
    videos: int | None = None
    """MP4s to keep under `videos/` in the output directory, at most (default: 4 where the environment renders
    images, else 0)."""
    videos_of: str = "sample"
    """Of which trials: `sample`, the first trial of scenarios spread over the set, the same ones for every
    policy; or `failures`, `successes`, `all`, comma-separated scenario ids."""
    render_device: str = "auto"
    """Where simulators draw: `auto` (the policy's GPU; on a Ray cluster the GPUs of a simulator's own
    machine, in turn), `cpu`, or a GPU's number."""
    ray_address: str = "auto"
    """A Ray cluster's address; `auto` finds the one this machine belongs to."""
    replicas: int = 0
    """Copies of the policy on a Ray cluster; 0 takes one per GPU, or a single one for a policy on the CPU."""
    sequential: str = ""
    """Trial log to compare with during the run, which stops as soon as the comparison is decided. `alone`
    compares with no other log and shows an interval that is valid at any time."""
    retry: str = ""
    """Run trials of these outcomes again (`policy_error,timeout,sim_error`); their old rows are kept beside
    the trial log, in `<log>.retried.jsonl`."""
    cross_cpu_deterministic: bool = False
    """Compute a diffusion policy's noise schedule in float64, so that its roots round alike on every
    processor; the last bit of its actions then differs from `lerobot-eval`'s."""
    portable: bool | None = None
    """Earlier name of `cross_cpu_deterministic`."""

    def __post_init__(self) -> None:
        move_old_fields(self, "--runner.", {"portable": "cross_cpu_deterministic"})

    @property
    def retried(self) -> list[str]:
        return [outcome.strip() for outcome in self.retry.split(",") if outcome.strip()]

    @property
    def workplace(self) -> Backend:
        """Where the run is."""
        return Backend(self.engine, self.ray_address, "--runner.", "slots", "--policy.device")

    def check(self) -> None:
        """Refuses what cannot be used.

        Raises:
            OptionError: naming the option, its value and what it may be.
        """
        self.workplace.check()
        check_retry(self.retried)
        for name, low, high in (
            ("slots", 0, 4096),
            ("max_batch", 1, 4096),
            ("batch_delay_ms", 0, 10_000),
            ("limit_seconds", 0, 10**8),
            ("videos", 0, 100_000),
            ("replicas", 0, 4096),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise OptionError(f"--runner.{name}={value}: must be from {low} to {high}")


@dataclass
class TrialsConfig(EvalConfig):
    """LeRobot's options of `--eval.*`. Of them only `n_episodes` is used."""

    n_episodes: int = 5
    """Trials of each scenario, as in the paper. `lerobot-eval` takes LeRobot's 50."""


@dataclass
class RecoveryEvalConfig(EvalPipelineConfig):
    """LeRobot's evaluation config, plus the runner's options."""

    eval: TrialsConfig = field(default_factory=TrialsConfig)  # ty: ignore[incompatible-mutable-override]
    runner: RunnerOptions = field(default_factory=RunnerOptions)

    def __post_init__(self) -> None:
        if path := parser.get_path_arg("policy"):
            check_checkpoint(path)
        super().__post_init__()

    @property
    def recovery_env(self) -> RecoveryEnvConfig:
        """`env`.

        Raises:
            OptionError: it is another kind of environment.
        """
        if not isinstance(self.env, RecoveryEnvConfig):
            raise OptionError(
                f"--env.type={self.env.type}: not a recovery env type; use roborecover_libero, say"
            )
        return self.env

    @property
    def given_policy(self) -> PreTrainedConfig:
        """`policy`.

        Raises:
            OptionError: there is none.
        """
        if self.policy is None:
            raise OptionError("no policy: give a checkpoint with --policy.path=FOLDER_OR_HUB_ID")
        return self.policy

    @property
    def folder(self) -> Path:
        """`output_dir`."""
        assert self.output_dir is not None, "LeRobot sets it where the user does not"
        return Path(self.output_dir)


def evaluate(cfg: RecoveryEvalConfig) -> int:
    """Runs the evaluation that a command line asks for; see `main`."""
    cfg.runner.check()
    check_seed(cfg.seed)
    env, policy = cfg.recovery_env, cfg.given_policy
    if cfg.eval.recording:
        raise OptionError(
            "--eval.recording=true: roborecover eval records no dataset. Use lerobot-eval for that, or "
            "--videos=N for videos"
        )
    out = cfg.folder
    facts = policy_metadata(
        policy,
        rename_map=cfg.rename_map,
        cross_cpu_deterministic=cfg.runner.cross_cpu_deterministic,
        n_episodes=cfg.eval.n_episodes,
        output_dir=out,
    )
    spec = env.run_spec(with_videos=_video_count(cfg) > 0)
    scenarios, run = create_session(env, spec, workers=True, facts=facts, run_seed=cfg.seed)
    with run:
        log = run.require_log()
        _check_same_options(run)
        if not run.rows():
            check_eval_info(out / "eval_info.json", log)
        if cfg.runner.retried:
            again, beside = run.retry(cfg.runner.retried)
            print(
                f"{pluralize(again, 'trial')} run again; the old rows are kept in {beside}", file=sys.stderr
            )
        stop = StopCondition(cfg.runner.limit_seconds)
        try:
            return _run(cfg, run, scenarios, stop)
        finally:
            stop.restore()


def _check_same_options(run: EvalSession) -> None:
    """Checks that a log has no rows of this policy and start under other options of the environment: a report
    could not tell them apart.

    Raises:
        OptionError: it has; names the options.
    """
    log, mine = run.require_log(), run.protocol
    for row in log.rows:
        if (row.policy, row.start, row.rewind_steps) != (mine.policy, mine.start, mine.rewind_steps):
            continue
        names = sorted(
            name for name in {*row.options, *mine.options} if row.options.get(name) != mine.options.get(name)
        )
        if names:
            told = ", ".join(
                f"{name} is {mine.options.get(name)!r} here and {row.options.get(name)!r} there"
                for name in names[:3]
            )
            raise OptionError(
                f"{log.path} has trials of this policy under other options: {told}. Give this run another "
                "--output_dir (or --env.trial_log), or the same options"
            )


def _run(cfg: RecoveryEvalConfig, run: EvalSession, scenarios: ScenarioSet, stop: StopCondition) -> int:
    """Runs what is missing in the log, reports, and says how to go on where trials are left."""
    log, ids, out = run.require_log(), [s.id for s in scenarios], cfg.folder
    watch = open_watch(
        cfg.runner.sequential, scenarios, run.protocol, cfg.eval.n_episodes,
        log=log.path, shard=cfg.recovery_env.shard,
    )  # fmt: skip
    progress = watch or RunProgress(run.protocol.start, ids, cfg.eval.n_episodes)
    progress.add([asdict(r) for r in run.rows()])
    line = ProgressLine(run.protocol.start, detailed=True)
    line.show(progress)

    def settled() -> bool:
        if watch is not None and watch.decided and not stop.reason:
            stop.reason = watch.words
        return watch is not None and watch.decided

    def show(row: TrialRow) -> None:
        progress.add([asdict(row)])
        line.show(progress)
        settled()

    videos, result, before = None, RunResult(), progress.done
    if count := _video_count(cfg):
        videos = VideoRecorder(out / "videos", count, cfg.runner.videos_of, ids, Start(run.protocol.start))
    if watch is not None:
        watch.record(log.path)
    if not settled():
        order = sorted(scenarios, key=lambda s: s.id) if watch is None else watch.order
        spec = host_spec(cfg)
        result = run_work_items(
            run, units_of(order, cfg.eval.n_episodes), partial(load_host, spec), _places(cfg),
            stop=stop, remedy=remedy_of(spec), on_row=show, videos=videos,
            batch_delay_s=cfg.runner.batch_delay_ms / 1e3,
            queue_of=WorkQueue if watch is None else OrderedQueue,
        )  # fmt: skip
    line.show(progress, final=True)
    if watch is not None:
        record = watch.record(log.path)
    report(cfg, run, scenarios, [] if videos is None else videos.kept)
    if videos is not None and before and len(videos.kept) < count:
        print(
            f"{pluralize(len(videos.kept), 'video')} of {count}: trials that the log had already are not run "
            "again. For videos of them, name another --output_dir",
            file=sys.stderr,
        )
    if watch is not None and record is not None:
        print(f"{watch.words}\nsequential {record}; the table's own intervals take no stop into account")
        if watch.decided:
            return _say_next(cfg, log.path)
    go_on = f"run the same command with --env.trial_log={log.path} --output_dir={out}"
    if stop.reason:
        print(
            f"{stop.reason}: {progress.done} of {progress.total} trials done; to go on, {go_on}",
            file=sys.stderr,
        )
        return stop.status
    if result.unrun:
        print(
            f"{pluralize(len(result.unrun), 'trial')} could not be run, and left no row: the policy was away "
            f"or hung ({result.problem}). To go on, {go_on}",
            file=sys.stderr,
        )
        return 1
    return _say_next(cfg, log.path)


def _say_next(cfg: RecoveryEvalConfig, log: Path) -> int:
    """Names the commands that report a finished run, and run the other start; not for a shard, or where
    another command runs this one."""
    out, (_, shards) = cfg.folder, cfg.recovery_env.shard_of()
    if NESTED in os.environ or shards != 1:
        return 0
    logged = str(out if log == out / "trials.jsonl" else log)
    start, report = Start(cfg.recovery_env.start), str(out / "report")
    recovery = str(out).removesuffix(_BESIDE)
    if start is Start.INITIAL and recovery != str(out) and Path(recovery, "trials.jsonl").exists():
        logs = [recovery, logged]  # as the run before has named it
    else:
        logs = [logged]
    print(next_command(["report", *logs, "--out", report]))
    if start is Start.RECOVERY:
        set_here = ("--env.start=", "--output_dir=", "--env.trial_log=")
        words = [word for word in sys.argv[1:] if not word.startswith(set_here)]
        again = ["eval", *words, f"--env.start={Start.INITIAL.value}", f"--output_dir={out}{_BESIDE}"]
        print(next_command(again, "or first, from initial states"))
        print(next_command(["report", logged, f"{out}{_BESIDE}", "--out", report], "then"))
    return 0


def host_spec(cfg: RecoveryEvalConfig) -> HostSpec:
    """The run's policy."""
    runner = cfg.runner
    return HostSpec(
        cfg.given_policy,
        cfg.recovery_env,
        cfg.rename_map,
        cfg.seed,
        runner.max_batch,
        runner.cross_cpu_deterministic,
    )


def _video_count(cfg: RecoveryEvalConfig) -> int:
    if cfg.runner.videos is None:
        return default_videos(cfg.recovery_env)
    return cfg.runner.videos


def _places(cfg: RecoveryEvalConfig) -> EngineConfig:
    env, runner = cfg.recovery_env, cfg.runner
    return EngineConfig(
        runner.workplace,
        runner.slots,
        runner.replicas,
        str(cfg.given_policy.device),
        env.obs_type != "state" or bool(_video_count(cfg)),
        runner.render_device,
        env.snapshot_dir or None,
    )


def report(cfg: RecoveryEvalConfig, run: EvalSession, scenarios: ScenarioSet, videos: Sequence[Path]) -> None:
    """Writes `eval_info.json` and prints the table.

    Args:
        cfg: the run's configuration.
        run: its log.
        scenarios: what was asked for.
        videos: files that were kept.
    """
    wanted = {s.id for s in scenarios}
    rows = [r for r in run.rows() if r.scenario_id in wanted and r.trial < cfg.eval.n_episodes]
    names = [(video_trial(p, Start(run.protocol.start)), p) for p in videos]
    by_trial = {name: str(p) for name, p in names if name}
    out = cfg.folder
    out.mkdir(parents=True, exist_ok=True)
    info = eval_info(rows, cfg.recovery_env.group_by, by_trial)
    atomic_write(out / "eval_info.json", json.dumps(info, indent=2) + "\n")
    print(format_table(summarise([asdict(r) for r in rows])))
    if lack := missing(rows):
        print(f"\nincomplete: {lack.words}")
    print(f"\ntrial log {run.require_log().path}\neval info {out / 'eval_info.json'}")
    if videos:
        print(f"videos {videos[0].parent} ({len(videos)})")


def main(argv: Sequence[str]) -> int:
    """Runs with a command line in `lerobot-eval`'s words.

    Args:
        argv: arguments without the program's and the command's name.
    """
    from lerobot_roborecover.policies.command_line import rewrite_env_argument

    init_logging()
    program, *words = rewrite_env_argument(["roborecover-eval", *long_names(argv, ALIASES)])
    return run_with_arguments(evaluate, program, words)
