"""What a build's file asks of a stage is what the stage's command asks with the same options."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest

from lerobot_roborecover.cli import collect
from lerobot_roborecover.cli.arguments import read_options
from lerobot_roborecover.cli.main import command_module, command_parser
from lerobot_roborecover.cli.tree import find_call
from lerobot_roborecover.curation.collect.options import CollectOptions
from lerobot_roborecover.curation.pipeline import requests
from lerobot_roborecover.curation.pipeline.config import OLD_KEYS, BuildPaths, ChainConfig, read_config
from lerobot_roborecover.errors import OptionError
from tests.curation.test_build import write

pytestmark = pytest.mark.lerobot

LEAST = {
    "out": "out", "platform": "fake", "collect": {"one": {"expert": "expert_biased", "draw": 3}},
    "annotate": {"no_consensus": "discuss"}, "screen": {"policies": [{"path": "lab/act"}]},
    "split": {"sizes": {"train": 0.8, "test": 0.2}}, "publish": {"repo_id": "org/name"},
}  # fmt: skip
"""Every option left out that has a default."""
MOST = {
    "out": "out", "platform": "fake", "license": "mit",
    "collect": {
        "one": {
            "expert": "expert_biased", "name": "me", "task": ["push-*", "a b"], "seeds": "0-4", "seed": 11,
            "reset_seed": 12, "trials": 2, "horizon": 99, "perturb": True, "perturb_steps": 5,
            "min_displacement": 2.5, "frames": 32, "frame_stride": 2, "no_exclude": ["a"],
            "exclude_only": ["b", "c"], "engine": "ray", "ray_address": "head:6379", "replicas": 2,
            "num_workers": 3, "max_batch": 2, "device": "cpu", "watchdog": 33,
            "retry_errors": True, "env": {"obs_type": "state", "flag": True, "list": [1, 2]},
            "rename_map": {"a": "b"},
        },
    },
    "annotate": {"votes": "votes", "votes_needed": 2, "tolerance": 4, "no_consensus": "drop"},
    "screen": {
        "policies": [
            {"path": "lab/act", "name": "act", "deterministic": True, "options": {"k": 1, "l": [1]},
             "env": {"obs_type": "state"}, "rename_map": {"c": "d"}},
            {"path": "lab/other"},
        ],
        "trials": 3, "keep": [2, 4], "max_invalid": 2, "run_seed": 5, "device": "cuda", "num_workers": 7,
        "engine": "ray", "ray_address": "head:6379", "replicas": 2, "max_batch": 3,
        "env": {"watchdog_s": 1.5},
    },
    "validate": {
        "runs": 2, "seed": 3, "tolerance_mm": 1.5, "min_ssim": 0.5, "no_frames": True, "no_outcomes": True,
        "engine": "ray", "ray_address": "head:6379", "num_workers": 3, "limit_s": 10, "env": {"a": "b"},
    },
    "split": {"sizes": {"train": 10, "test": 5}, "seed": 4, "disjoint_by": "trajectory,record"},
    "render": {"frames": 128, "num_workers": 3, "env": {"q": "fast"}},
    "publish": {
        "repo_id": "org/name", "version": "2.0.0", "private": True, "title": "A title", "no_pictures": True,
        "anonymise": True,
    },
}  # fmt: skip
COMMANDS = {
    "least": {
        "collect": "--env.type=roborecover_fake --expert expert_biased --draw 3 --out out/collect/one",
        "agree": "out/candidates --votes out/votes --out out/scenarios",
        "screen": "out/scenarios --policy lab/act --out out/screened",
        "validate": "out/screened --trials-folder out/screened.trials --candidates out/candidates "
        "--out out/validated",
        "split": "out/validated --train 0.8 --test 0.2 --out out/split",
        "render": "out/split --out out/rendered",
        "publish": "out/rendered --repo-id org/name",
    },
    "most": {
        "collect": "--env.type=roborecover_fake --expert expert_biased --name me --task push-* --task a%b "
        "--seeds 0-4 --seed 11 --reset-seed 12 --trials 2 --horizon 99 --perturb --perturb-steps 5 "
        "--min-displacement 2.5 --frames 32 --frame-stride 2 --no-exclude a --exclude-only b "
        "--exclude-only c --engine ray --ray-address head:6379 --replicas 2 "
        "--num-workers 3 --max-batch 2 --device cpu --watchdog 33 --retry-errors --env.flag=true "
        '--env.list=[1,%2] --env.obs_type=state --rename_map {"a":"b"} --license mit --out out/collect/one',
        "agree": "out/candidates --votes votes --votes-needed 2 --tolerance 4 --no-consensus drop "
        "--license mit --out out/scenarios",
        "screen": "out/scenarios --policy act=lab/act --policy lab/other --deterministic act "
        "--policy-option act:k=1 --policy-option act:l=[1] --env act:obs_type=state --env watchdog_s=1.5 "
        '--rename-map act:{"c":"d"} --trials 3 --keep 2 4 --max-invalid 2 --run-seed 5 --device cuda '
        "--engine ray --ray-address head:6379 --replicas 2 --num-workers 7 --max-batch 3 --out out/screened",
        "validate": "out/screened --trials-folder out/screened.trials --candidates out/candidates --runs 2 "
        "--seed 3 --tolerance-mm 1.5 --min-ssim 0.5 --no-frames --no-outcomes --engine ray "
        "--ray-address head:6379 --num-workers 3 --limit-s 10 "
        "--env a=b --out out/validated",
        "split": "out/validated --split train=10 --split test=5 --seed 4 --disjoint-by trajectory,record "
        "--out out/split",
        "render": "out/split --frames 128 --num-workers 3 --env q=fast --out out/rendered",
        "publish": "out/rendered --repo-id org/name --version 2.0.0 --private --title A%title --no-pictures "
        "--anonymise",
    },
}
"""Arguments of the same; % stands for a blank within one."""


def words(text: str) -> list[str]:
    return [word.replace("%", " ") for word in text.split()]


def parsed(command: str, text: str) -> Any:
    call = find_call([command, *words(text)])
    assert call is not None
    return read_options(command_module(call.module).OPTIONS, command_parser(call).parse_args(call.rest))


def plain(request: object) -> object:
    """A request as dicts and lists, so that a tuple is as good as a list, and a path as its name."""
    if isinstance(request, dict):
        return {key: plain(value) for key, value in request.items()}
    if isinstance(request, (list, tuple)):
        return [plain(value) for value in request]
    return str(request) if isinstance(request, Path) else request


def same(mine, command) -> None:
    assert isinstance(command, type(mine))
    assert plain(asdict(mine)) == plain(asdict(command))


def one(content: dict, tmp_path: Path) -> tuple[ChainConfig, BuildPaths]:
    config = read_config(write(tmp_path / "build.yaml", content))
    return config, BuildPaths(config)


@pytest.mark.parametrize(("name", "content"), [("least", LEAST), ("most", MOST)])
def test_a_file_and_its_commands_ask_for_the_same(tmp_path, name, content):
    config, places = one(content, tmp_path)
    told = COMMANDS[name]
    parser = collect.build_parser()
    options = requests.collect_options(config, "one", config.collect["one"], places.collected("one"))
    args, rest = parser.parse_known_args([*words(told["collect"]), "--work", str(options.work)])
    same(options, collect.options(parser, read_options(CollectOptions, args), rest))
    same(requests.agree_request(config, places), parsed("agree", told["agree"]))
    same(requests.screen_request(config, places), parsed("screen", told["screen"]).request())
    same(requests.validation_request(config, places), parsed("validate", told["validate"]))
    same(requests.split_config(config), parsed("split", told["split"]).config())
    same(requests.render_request(config, places), parsed("render", told["render"]))
    assert config.publish is not None
    same(requests.publish_request(config.publish, places), parsed("publish", told["publish"]))


def test_earlier_keys_ask_for_the_same(tmp_path, capsys):
    earlier = {new: old for old, new in OLD_KEYS.items() if old != "slots"}
    content = MOST | {"screen": {**MOST["screen"], "early_stop": True}}

    def older(value):
        if not isinstance(value, dict):
            return value
        return {earlier.get(k, k): older(v) for k, v in value.items()}

    assert one(older(content), tmp_path)[0] == one(content, tmp_path)[0]
    said = capsys.readouterr().err
    assert "note: collect.one.film_every is now collect.one.frame_stride\n" in said
    assert "note: screen.curtail is now screen.early_stop\n" in said
    render = {"workers": 1, "num_workers": 2}
    with pytest.raises(OptionError, match=r"render\.workers is the earlier name of render\.num_workers"):
        one(MOST | {"render": render}, tmp_path)


def test_a_zero_is_not_left_out(tmp_path):
    content = {
        **LEAST,
        "collect": {"one": {"expert": "expert_biased", "seeds": 0, "seed": 0}},
        "screen": {**LEAST["screen"], "run_seed": 0},
        "validate": {"seed": 0, "min_ssim": 0},
        "split": {**LEAST["split"], "seed": 0},
    }
    config, places = one(content, tmp_path)
    options = requests.collect_options(config, "one", config.collect["one"], places.collected("one"))
    assert (options.starts.seeds, options.starts.seed, options.seed) == ((0,), 0, 0)
    assert requests.screen_request(config, places).run_seed == 0
    rule = requests.validation_request(config, places).rule
    assert (rule.seed, rule.min_ssim) == (0, 0)
    assert requests.split_config(config).seed == 0


def test_people_s_rejections_are_read_from_their_file(tmp_path):
    (tmp_path / "rejects.txt").write_text("# looked at the sheets\nid-1 the cup is gone\n")
    config, places = one({**LEAST, "validate": {"rejects": str(tmp_path / "rejects.txt")}}, tmp_path)
    assert requests.validation_request(config, places).rejects == {"id-1": "the cup is gone"}
