"""What is shown of the output of a program that failed, and tables for the terminal."""

from __future__ import annotations

import json

import pytest

from lerobot_roborecover.utils.text import align, install_command, output_end

BAR = "Stepping through eval batches:  {n:2}%|##   | {n}/100 [00:01<00:09,  9.9it/s]"
BARS = "\r".join(BAR.format(n=n) for n in range(60))


@pytest.mark.parametrize(
    ("output", "cause", "shown"),
    [
        (
            f"{BARS}\nTraceback:\n  x = 1\npkg.LogError: in use\n{BARS}", "pkg.LogError: in use",
            ["Traceback:", "  x = 1", "pkg.LogError: in use"],
        ),
        (
            f"{BARS}ValueError: 3 [of 4]\nbye\n12it [00:01, 3.2it/s]", "ValueError: 3 [of 4]",
            ["ValueError: 3 [of 4]", "bye"],
        ),
        ("a: no such option\n", "a: no such option", ["a: no such option"]),
        ("Error: one\nKeyError: 'two'\n", "KeyError: 'two'", ["Error: one", "KeyError: 'two'"]),
        (BARS, "", []),
        ("", "", []),
    ],
)  # fmt: skip
def test_the_end_of_an_output_is_its_cause_and_no_progress_bars(output, cause, shown):
    assert output_end(output, 9) == (cause, "\n".join(f"  {line}" for line in shown))


def test_only_so_many_lines_are_shown():
    assert output_end("OSError: full\n1\n2\n3\n", 2) == ("OSError: full", "  2\n  3")


def test_a_table_is_aligned_and_has_no_blanks_at_its_end():
    rows = [("stage", "kept", ""), ("collect", 12, "stuck"), ("agree", 3, "")]
    assert align(rows, left=(0, 2)) == ["stage    kept", "collect    12  stuck", "agree       3"]
    assert align([("a", 1), ("b", 20)], left=()) == ["a   1", "b  20"]
    assert align([]) == []


def test_a_clone_is_installed_from_where_it_is(monkeypatch, tmp_path):
    """Also in its own folder, where what its build left says nothing of where it came from."""
    built, installed = tmp_path / "clone" / "stray.egg-info", tmp_path / "site" / "stray-1.0.dist-info"
    for folder, name in ((installed, "METADATA"), (built, "PKG-INFO")):  # the last is found first
        folder.mkdir(parents=True)
        (folder / name).write_text("Metadata-Version: 2.1\nName: stray\nVersion: 1.0\n")
        monkeypatch.syspath_prepend(folder.parent)
    command = install_command.__wrapped__  # without what it keeps
    assert command("so101", "stray") == "pip install 'stray[so101]'"
    source = {"url": (tmp_path / "clone").as_uri(), "dir_info": {"editable": True}}
    (installed / "direct_url.json").write_text(json.dumps(source))
    assert command("so101", "stray") == f"uv pip install -e '{tmp_path / 'clone'}[so101]'"
