"""The arguments that LeRobot's parser reads."""

import sys
from dataclasses import dataclass

import pytest

pytestmark = pytest.mark.lerobot


def test_the_process_has_its_own_arguments_back(monkeypatch):
    from lerobot_roborecover.policies.command_line import process_arguments

    held = ["program", "--one"]
    monkeypatch.setattr(sys, "argv", held)
    with process_arguments("roborecover-eval", ("--two=2", "--three")):
        assert sys.argv == ["roborecover-eval", "--two=2", "--three"]
    assert held == ["program", "--one"]
    with pytest.raises(ZeroDivisionError), process_arguments("other", []):
        1 / len(sys.argv[1:])
    assert sys.argv is held, "who holds the list sees the same"
    assert held == ["program", "--one"]


def test_lerobots_parser_reads_them():
    from lerobot_roborecover.policies.command_line import run_with_arguments

    @dataclass
    class Config:
        steps: int = 1

    def steps(config: Config) -> int:
        return config.steps

    before = sys.argv[:]
    assert run_with_arguments(steps, "roborecover-eval", ["--steps=7"]) == 7
    assert sys.argv == before


def test_what_a_file_says_of_a_policy_is_said_to_its_own_run_alone(tmp_path):
    from lerobot.configs import parser

    from lerobot_roborecover.policies.command_line import run_with_arguments

    @dataclass
    class Config:
        steps: int = 1

        @classmethod
        def __get_path_fields__(cls) -> list[str]:
            return ["policy"]

    def policies(config: Config):
        return parser.get_path_arg("policy"), parser.get_yaml_overrides("policy")

    first, second = tmp_path / "first.yaml", tmp_path / "second.yaml"
    first.write_text("steps: 2\npolicy: {path: here, device: cpu}\n")
    second.write_text("steps: 3\n")
    found = [run_with_arguments(policies, "program", [f"--config_path={p}"]) for p in (first, second, first)]
    assert found == [("here", ["--device=cpu"]), (None, []), ("here", ["--device=cpu"])]


def test_what_lerobot_prints_for_every_checkpoint_is_left_out(capsys):
    from lerobot_roborecover.policies.command_line import plain_output

    with plain_output():
        print("Loading weights from local directory")
        print("two\nlines", end=" and a half")
    print()
    assert capsys.readouterr().out == "two\nlines and a half\n"
