"""The one bar of long commands."""

from __future__ import annotations

from lerobot_roborecover.utils.progress import Progress


def test_each_thing_has_a_bar_that_ends_full(capsys):
    progress = Progress("trial")
    for name, total in (("act", 3), ("tdmpc", 2)):
        for done in range(total + 1):
            progress.of(name, done, total)
    out, err = capsys.readouterr()
    assert out == "", "results alone go there"
    ends = [line.split("\r")[-1] for line in err.strip("\n").split("\n")]
    assert [e.split(":")[0] for e in ends] == ["act", "tdmpc"]
    assert ["3/3" in ends[0], "2/2" in ends[1]] == [True, True]


def test_what_is_cut_off_keeps_its_count(capsys):
    progress = Progress("part")
    progress(0, 4)
    progress(1, 4)
    progress.close()
    assert "1/4" in capsys.readouterr().err
