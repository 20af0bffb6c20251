"""What the plugin changes in `lerobot-eval`, and leaves alone elsewhere."""

from __future__ import annotations

import signal

import pytest

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.utils.signals import Terminated

pytestmark = pytest.mark.lerobot


@pytest.mark.parametrize(
    ("argv", "ours"),
    [
        (["/venv/bin/lerobot-eval", "--env.type=roborecover_fake", "--policy.path=p"], True),
        (["/venv/bin/lerobot-eval", "--env.type=libero", "--policy.path=roborecover_x"], False),
        (["/venv/bin/lerobot-train", "--env.type=roborecover_fake"], False),
    ],
)
def test_stop_signals_are_handled_in_evaluations_of_ours_alone(argv, ours):
    from lerobot_roborecover.plugin import is_ours

    assert is_ours(argv) is ours


def test_refusals_and_stop_signals_are_one_line(capsys):
    from lerobot_roborecover.plugin import plain_errors

    for error, said in (
        (OptionError("no such thing"), "error: no such thing\n"),
        (Terminated(signal.SIGTERM), "error: ended by SIGTERM; finished trials are kept\n"),
    ):
        plain_errors(type(error), error, None)
        assert capsys.readouterr().err == said
    plain_errors(ValueError, ValueError("a bug"), None)
    assert "ValueError: a bug" in capsys.readouterr().err
