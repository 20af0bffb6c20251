"""A build's stages as requests: what its file asks of each stage's own function.

What the file leaves out is the stage's default.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path

from lerobot_roborecover.curation.agree import AgreeRequest
from lerobot_roborecover.curation.collect.judge import FilterConfig
from lerobot_roborecover.curation.collect.options import CollectOptions, parse_side
from lerobot_roborecover.curation.collect.starts import parse_numbers
from lerobot_roborecover.curation.pipeline.config import (
    ChainConfig,
    CollectPart,
    PublishPart,
    RenderPart,
    ScreenPart,
    ValidatePart,
)
from lerobot_roborecover.curation.pipeline.paths import BuildPaths
from lerobot_roborecover.curation.publishing import PublishRequest
from lerobot_roborecover.curation.render import RenderRequest
from lerobot_roborecover.curation.resolution import ResolutionConfig
from lerobot_roborecover.curation.screen.dataset import ScreenRequest
from lerobot_roborecover.curation.screen.runs import PolicySpec
from lerobot_roborecover.curation.screen.screening import ScreenRule
from lerobot_roborecover.curation.split import SplitConfig, check_least, check_sizes, parse_apart
from lerobot_roborecover.curation.validate.request import ValidationRequest, read_rejects
from lerobot_roborecover.curation.validate.validation import ValidationRule
from lerobot_roborecover.datasets.publish import PublishConfig
from lerobot_roborecover.platforms.starts import Starts
from lerobot_roborecover.policies.identity import policy_identity
from lerobot_roborecover.workers.backend import LOCAL, Backend


def given[T](value: T | None, default: T) -> T:
    """An option of the file, or the stage's default."""
    return default if value is None else value


def assignments(values: Mapping[str, object]) -> tuple[str, ...]:
    """Options of a config that draccus reads, as `name=value`."""
    return tuple(f"{name}={_text(value)}" for name, value in values.items())


def _text(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return json.dumps(value) if isinstance(value, (list, dict)) else str(value)


def workplace(part: CollectPart | ScreenPart | ValidatePart) -> Backend:
    """Where a stage's simulators are."""
    return Backend(given(part.engine, LOCAL.engine), given(part.ray_address, LOCAL.address))


def collect_options(config: ChainConfig, name: str, part: CollectPart, out: Path) -> CollectOptions:
    """Of one way in which rollouts come about.

    Args:
        config: the whole file.
        name: of this way.
        part: its options.
        out: folder of its candidates.

    Raises:
        OptionError, ScenarioError: numbers or sizes are written otherwise.
    """
    default = CollectOptions
    starts = Starts(
        seeds=_numbers(part.seeds, "--seeds"),
        init_states=_numbers(part.init_states, "--init-states"),
        draw=given(part.draw, Starts.draw),
        seed=given(part.seed, Starts.seed),
        trials=given(part.trials, Starts.trials),
        reset_seed=given(part.reset_seed, Starts.reset_seed),
    )
    judging = FilterConfig(
        tuple(part.no_exclude),
        tuple(part.exclude_only),
        given(part.min_displacement, FilterConfig.min_displacement_mm),
    )
    return CollectOptions(
        platform=config.platform,
        out=out,
        starts=starts,
        tasks=tuple(part.task),
        policy=given(part.policy, default.policy),
        expert=given(part.expert, default.expert),
        name=given(part.name, default.name),
        work=Path(f"{out}.work-{_rollouts_key(part)}"),
        env=assignments(part.env),
        policy_options=assignments(part.policy_options),
        rename_map=part.rename_map,
        device=part.device,
        perturb=given(part.perturb, default.perturb),
        perturbed_steps=given(part.perturb_steps, default.perturbed_steps),
        judging=judging,
        seed=given(part.seed, default.seed),
        horizon=given(part.horizon, default.horizon),
        frame_stride=given(part.frame_stride, default.frame_stride),
        frames=parse_side(str(given(part.frames, default.frames))),
        workplace=workplace(part),
        slots=given(part.num_workers, default.slots),
        replicas=given(part.replicas, default.replicas),
        max_batch=given(part.max_batch, default.max_batch),
        watchdog_s=given(part.watchdog, default.watchdog_s),
        retry_errors=given(part.retry_errors, default.retry_errors),
        license=config.license,
    )


def _numbers(value: str | int | None, option: str) -> tuple[int, ...]:
    return () if value in (None, "") else parse_numbers(str(value), option)


def _rollouts_key(part: CollectPart) -> str:
    """Of what decides the rollouts themselves: with other starts, rules or pictures they are used again."""
    names = (
        "expert", "name", "seed", "reset_seed", "horizon", "perturb", "perturb_steps", "max_batch", "env",
        "policy_options", "rename_map",
    )  # fmt: skip
    policy = policy_identity(part.policy) if part.policy else ""
    decisive = [policy, {name: getattr(part, name) for name in names}]
    return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()[:8]


def resolution_config(config: ChainConfig) -> ResolutionConfig:
    """How votes become labels."""
    part = config.annotate
    no_consensus = "discuss" if part.no_consensus == "discuss" else "drop"
    return ResolutionConfig(part.votes_needed, part.tolerance, no_consensus)


def agree_request(config: ChainConfig, places: BuildPaths) -> AgreeRequest:
    """Of the votes on all candidates."""
    return AgreeRequest(
        dataset=places.candidates,
        votes=places.votes,
        config=resolution_config(config),
        out=places.scenarios,
        license=config.license,
    )


def screen_rule(config: ChainConfig) -> ScreenRule:
    """Who stays.

    Raises:
        ScenarioError: bounds or numbers make no sense.
    """
    part = config.screen
    keep = ScreenRule.keep if part.keep is None else (str(part.keep[0]), str(part.keep[1]))
    rule = ScreenRule
    return ScreenRule(
        given(part.trials, rule.trials),
        keep,
        given(part.max_invalid, rule.max_invalid),
        given(part.early_stop, rule.curtail),
    )


def screen_request(config: ChainConfig, places: BuildPaths, rule: ScreenRule) -> ScreenRequest:
    """Of the scenarios that the votes resolved to.

    Args:
        config: the whole file.
        places: of the build.
        rule: of `screen_rule`.

    Raises:
        OptionError: a policy's name is not one.
    """
    part = config.screen
    policies = [
        PolicySpec(p.path, given(p.name, ""), assignments(p.options), assignments(p.env), p.rename_map)
        for p in part.policies
    ]
    return ScreenRequest(
        dataset=str(places.scenarios),
        policies=policies,
        out=places.screened,
        rule=rule,
        deterministic=[spec.name for spec, p in zip(policies, part.policies, strict=True) if p.deterministic],
        run_seed=given(part.run_seed, ScreenRequest.run_seed),
        env=assignments(part.env),
        device=part.device,
        slots=given(part.num_workers, ScreenRequest.slots),
        max_batch=given(part.max_batch, ScreenRequest.max_batch),
        workplace=workplace(part),
        replicas=given(part.replicas, ScreenRequest.replicas),
    )


def validation_request(config: ChainConfig, places: BuildPaths) -> ValidationRequest:
    """Of the scenarios that screening kept.

    Raises:
        ScenarioError: the rule makes no sense, or rejections cannot be read.
    """
    part, rule, default = config.validate, ValidationRule, ValidationRequest
    return ValidationRequest(
        dataset=places.screened,
        trials_folder=places.screened.with_name(f"{places.screened.name}.trials"),
        out=places.validated,
        candidates=[places.candidates],
        rule=ValidationRule(
            runs=given(part.runs, rule.runs),
            seed=given(part.seed, rule.seed),
            tolerance_mm=given(part.tolerance_mm, rule.tolerance_mm),
            min_ssim=given(part.min_ssim, rule.min_ssim),
            frames=not part.no_frames,
            outcomes=not part.no_outcomes,
        ),
        env=assignments(part.env),
        rejects=read_rejects(Path(part.rejects) if part.rejects else None),
        workers=given(part.num_workers, default.workers),
        workplace=workplace(part),
        limit_s=given(part.limit_s, default.limit_s),
    )


def split_config(config: ChainConfig) -> SplitConfig:
    """How to divide.

    Raises:
        ScenarioError: sizes or keys are not such.
    """
    part = config.split
    fractions = any(size != int(size) for size in part.sizes.values())
    sizes = {name: float(size) if fractions else int(size) for name, size in part.sizes.items()}
    check_least(part.min_per_split or {}, sizes)
    return SplitConfig(
        check_sizes(sizes),
        given(part.seed, SplitConfig.seed),
        parse_apart(part.disjoint_by),
        part.min_per_split or {},
    )


def render_request(config: ChainConfig, places: BuildPaths) -> RenderRequest:
    """Of the divided scenarios."""
    part, default = given(config.render, RenderPart()), RenderRequest
    return RenderRequest(
        places.split,
        places.rendered,
        given(part.frames, default.size),
        assignments(part.env),
        given(part.num_workers, default.workers),
    )


def publish_request(part: PublishPart, places: BuildPaths) -> PublishRequest:
    """Of what a build ends with."""
    default = PublishConfig
    publish = PublishConfig(
        repo_id=part.repo_id,
        version=given(part.version, default.version),
        private=given(part.private, default.private),
        title=given(part.title, default.title),
        pictures=not part.no_pictures,
    )
    return PublishRequest(places.result, publish, anonymise=given(part.anonymise, False))
