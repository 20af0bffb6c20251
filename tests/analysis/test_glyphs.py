"""A figure never shows a box in the place of a character."""

from __future__ import annotations

import warnings

import pytest

from lerobot_roborecover.analysis.analyse import analyse
from lerobot_roborecover.analysis.figures import glyphs
from lerobot_roborecover.analysis.figures.glyphs import drawable, families
from lerobot_roborecover.analysis.figures.rates import all_figures
from lerobot_roborecover.analysis.figures.style import drawing, png_of, svg_of
from lerobot_roborecover.analysis.logs import read_study
from lerobot_roborecover.analysis.options import Options
from tests.support.trial_rows import policy_rows, write_log


def test_characters_without_a_glyph_stand_by_their_numbers():
    assert drawable("act, café, µ, Привет") == "act, café, µ, Привет"
    assert drawable("a \U0010fffd b") == "a [U+10FFFD] b"
    assert drawable("\U0010fffd\U0010fffc") == "[U+10FFFD U+10FFFC]"
    assert drawable("\U0010fffd" * 7).endswith("and 3 more]")


def test_an_installed_font_is_used(monkeypatch):
    from matplotlib import font_manager

    known = [*font_manager.get_font_names(), "Noto Sans CJK SC"]
    monkeypatch.setattr(font_manager, "get_font_names", lambda: known)
    families.cache_clear()
    try:
        assert families()[:2] == ["DejaVu Sans", "Noto Sans CJK SC"]
    finally:
        families.cache_clear()


@pytest.mark.nightly
def test_no_figure_of_a_report_shows_a_box(tmp_path):
    logs = [
        str(write_log(tmp_path / f"{n}.jsonl", policy_rows(name, 8, 2, 0.5, n, task="把碗放在盘子上")))
        for n, name in enumerate(("模型一", "テスト", "act@1", "𠀀"))
    ]
    results = analyse(read_study(logs), Options(draws=100))
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # matplotlib warns of a missing glyph
        for figure in all_figures(results):
            for plot in filter(None, (figure.plot, figure.narrow)):
                assert png_of(plot)
                assert svg_of(plot)


def test_labels_of_axes_keep_their_places():
    with drawing() as subplots:
        plot, axes = subplots(3, 2)
        axes.set_yticks([0, 1], ["\U0010fffd", "act"])
        axes.set_title("of \U0010fffd")
    png_of(plot)
    assert [t.get_text() for t in axes.get_yticklabels()] == ["[U+10FFFD]", "act"]
    assert axes.get_title(loc="left") == "of [U+10FFFD]"


def test_a_damaged_font_is_left_out(monkeypatch):
    from matplotlib import font_manager

    def damaged(path):
        raise RuntimeError("can not load face")

    monkeypatch.setattr(font_manager, "get_font", damaged)
    glyphs._drawn.cache_clear()
    try:
        assert glyphs._drawn() == frozenset()
    finally:
        glyphs._drawn.cache_clear()
