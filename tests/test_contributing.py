"""The worked examples of CONTRIBUTING.md: each runs as it stands there."""

from __future__ import annotations

import re
import sys
import types
from pathlib import Path

from lerobot_roborecover.cli.arguments import Parser, add_options, read_options
from lerobot_roborecover.policies.remote.mapping import parse_mapping
from tests.support.trial_rows import three_policies

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "CONTRIBUTING.md").read_text()


def example(title: str, language: str) -> str:
    """The one block of code of a section."""
    section = re.split(r"^###? ", PAGE.split(f"### {title}\n")[1], flags=re.MULTILINE)[0]
    (code,) = re.findall(rf"```{language}\n(.*?)```", section, re.DOTALL)
    return code


def test_a_metric(tmp_path, capsys):
    exec(example("A metric", "python"), {"logs": three_policies(tmp_path, count=12)})
    said = capsys.readouterr().out
    assert "Recovered in 50 steps %" in said
    assert re.search(r"\d+\.\d \[", said)


def test_a_command(tmp_path, monkeypatch, capsys):
    module = types.ModuleType("a_command")
    monkeypatch.setitem(sys.modules, "a_command", module)
    (tmp_path / "a_command.py").write_text(example("A command, an option", "python"))
    module.__file__ = str(tmp_path / "a_command.py")
    exec(compile((tmp_path / "a_command.py").read_text(), module.__file__, "exec"), vars(module))
    parser = Parser(prog="roborecover count")
    add_options(parser, module.OPTIONS)
    assert "rows to read, at most (100)" in parser.format_help()
    args = parser.parse_args(["log", "--most", "5"])
    assert "--most is now --limit" in capsys.readouterr().err
    options = read_options(module.OPTIONS, args)
    assert options == module.CountOptions(log=Path("log"), limit=5)
    assert module.run(options) == 0


def test_a_policy_server():
    assert parse_mapping(example("A policy server", "yaml"), "CONTRIBUTING.md").actions.execute == 3


def test_a_page():
    names: dict = {}
    exec(example("A page", "python"), names)
    assert "Who worked" in names["html"]
    assert "Simulators" in names["html"]


def test_a_platform():
    assert (ROOT / "examples" / "crane" / "roborecover_crane.py").is_file()
