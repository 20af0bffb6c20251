"""The tree of commands: each is found and says what it takes, under its name and under its old one."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

from lerobot_roborecover.cli.main import build_parser, command_module, main
from lerobot_roborecover.cli.tree import COMMANDS, GROUPS, SPLIT_NAMES, in_group, overview

OURS = [c for c in COMMANDS if not hasattr(command_module(c.module), "pass_through")]
"""Those whose arguments we parse; LeRobot parses the others'."""
OLD = [c for c in OURS if c.old]


def names(command) -> str:
    return command.name


def ended(argv: list[str], status: int, capsys) -> tuple[str, str]:
    """What a command line that ends in its parser prints."""
    with pytest.raises(SystemExit) as raised:
        main(argv)
    assert raised.value.code == status
    said = capsys.readouterr()
    return said.out, said.err


@pytest.mark.parametrize("command", OURS, ids=names)
def test_it_says_what_it_takes(command, capsys):
    out, err = ended([*command.name.split(), "--help"], 0, capsys)
    assert out.startswith(f"usage: roborecover {command.name} ")
    assert "".join(command_module(command.module).HELP.split()) in "".join(out.split()), "whatever the width"
    assert err == ""


@pytest.mark.parametrize("command", OLD, ids=names)
def test_an_old_name_takes_the_same_and_says_the_new_one(command, capsys):
    new, _ = ended([*command.name.split(), "--help"], 0, capsys)
    old, err = ended([command.old, "--help"], 0, capsys)
    assert err == f'note: "roborecover {command.old}" is now "roborecover {command.name}"\n'
    _, _, options = old.partition("options:")
    assert options == new.partition("options:")[2]
    assert old.startswith(f"usage: roborecover {command.old} ")


def test_an_old_name_that_is_two_commands_says_both(capsys):
    for name, (_, now) in SPLIT_NAMES.items():
        out, err = ended([name, "--help"], 0, capsys)
        assert out.startswith(f"usage: roborecover {name} ")
        assert err.count("\n") == 1
        assert all(f'"roborecover {n}"' in err for n in now)


def test_an_old_name_that_another_parser_reads_notes_it_too(capsys):
    assert main(["collect", "--expert", "?", "--env.type=roborecover_fake"]) == 0
    old = capsys.readouterr()
    assert old.err == 'note: "roborecover collect" is now "roborecover curate collect"\n'
    assert main(["curate", "collect", "--expert", "?", "--env.type=roborecover_fake"]) == 0
    new = capsys.readouterr()
    assert (new.out, new.err) == (old.out, "")


def test_an_old_name_refuses_under_its_own_name(tmp_path, capsys):
    for argv in (["split"], ["curate", "split"]):
        assert main([*argv, str(tmp_path / "none"), "--train", "1"]) == 2
        line = capsys.readouterr().err.splitlines()[-1]
        assert line.startswith(f"roborecover {' '.join(argv)}: ")


def test_help_is_one_screen_and_lists_everything(capsys):
    out, err = ended(["--help"], 0, capsys)
    lines = out.splitlines()
    assert err == ""
    assert len(lines) <= 24
    assert max(map(len, lines)) <= 80
    words = set(re.findall(r"[\w-]+", out))
    assert [c.name for c in COMMANDS if c.word not in words] == []


def test_the_page_of_commands_is_what_help_prints():
    docs = Path(__file__).parents[2] / "docs"
    assert f"```\n{overview()}```" in (docs / "commands.md").read_text()
    old_names = (docs / "log" / "old_names.md").read_text()
    assert [c.old for c in COMMANDS if c.old and f"`{c.old}`" not in old_names] == []


def test_a_completion_script_knows_groups_commands_and_options():
    shtab = pytest.importorskip("shtab", reason="uv pip install shtab")
    script = shtab.complete(build_parser(), shell="bash")
    words = set(re.findall(r"[\w-]+", script))
    assert {"curate", "training-data", "--trials-folder"} <= words
    assert "eval-monitor" not in words


@pytest.mark.parametrize("group", GROUPS)
def test_help_of_a_group_has_a_line_for_each_command(group, capsys):
    out, _ = ended([group, "--help"], 0, capsys)
    assert out.startswith(f"usage: roborecover {group} COMMAND")
    for command in in_group(group):
        assert re.search(rf"^  {command.word} +{re.escape(command.summary)}$", out, re.M)
    assert max(map(len, out.splitlines())) <= 80


def test_without_a_command_the_help_is_printed_and_the_status_is_2(capsys):
    for argv in ([], ["curate"]):
        shown, _ = ended([*argv, "--help"], 0, capsys)
        out, err = ended(argv, 2, capsys)
        assert (out, err) == ("", shown)


@pytest.mark.parametrize(
    ("typed", "nearest"),
    [
        ("vaildate", "curate validate"),
        ("reprot --out x", "report"),
        ("evaluate", "eval"),
        ("training-data logs", "curate training-data"),
        ("eval-monitors", "detect evaluate"),
        ("datasets", "dataset"),
        ("curate splt --train 1", "curate split"),
        ("curate inspect", "dataset inspect"),
        ("check polcy", "check policy"),
    ],
)
def test_a_wrong_command_names_the_nearest(typed, nearest, capsys):
    out, err = ended(typed.split(), 2, capsys)
    assert out == ""
    assert err.splitlines()[-1].endswith(f'the nearest is "roborecover {nearest}"')


def test_a_command_that_is_like_none_points_to_the_help(capsys):
    _, err = ended(["xyzzy"], 2, capsys)
    assert '"roborecover --help" lists them' in err


def test_no_name_means_two_things():
    typed = [c.name for c in COMMANDS] + [c.old for c in COMMANDS if c.old] + [*GROUPS, *SPLIT_NAMES]
    assert len(typed) == len(set(typed))
    assert {c.group for c in COMMANDS} == {"", *GROUPS}


@pytest.mark.nightly
@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS, ids=names)
def test_the_installed_command_starts(command):
    program = Path(sys.executable).with_name("roborecover")
    done = subprocess.run([program, *command.name.split(), "--help"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--" in done.stdout
