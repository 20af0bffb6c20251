"""How far a demo is, as its log tells."""

import io

from lerobot_roborecover.evaluation.progress import LogTail, ProgressLine, RunProgress
from tests.support.demo_rows import rows_of


def test_log_tail_waits_for_the_end_of_a_line(tmp_path):
    path = tmp_path / "log"
    tail = LogTail(path)
    assert tail.read() == []
    path.write_text('{"a": 1}\n{"a"')
    assert tail.read() == [{"a": 1}]
    assert tail.read() == []
    with path.open("a") as stream:
        stream.write(": 2}\n")
    assert tail.read() == [{"a": 2}]


def test_progress_counts_what_was_asked_for(dataset):
    ids = ["fake-push-left-000", "fake-push-right-001"]
    counts = RunProgress("recovery", ids, 2)
    outcomes = {ids[0]: ["success", "horizon", "success"], "fake-push-left-002": ["success"]}
    counts.add(rows_of(dataset, outcomes) + rows_of(dataset, {ids[1]: ["success"]}, start="initial"))
    assert (counts.done, counts.total, counts.rate) == (2, 4, 0.5)
    counts.add(rows_of(dataset, {ids[1]: ["success"]}))
    assert counts.rate == 0.75, "scenarios count the same, however many of their trials are done"


def test_progress_line_tells_the_pace_of_trials_alone(dataset):
    ids = ["fake-push-left-000", "fake-push-right-001"]
    counts = RunProgress("recovery", ids, 3)
    now = [0.0]
    stream = io.StringIO()
    progress = ProgressLine("recovery", stream, lambda: now[0])

    def shown(at_s: float, **finished: list[str]) -> str:
        now[0] = at_s
        counts.add(rows_of(dataset, {ids[int(k[1])]: v for k, v in finished.items()}))
        progress.show(counts, final=True)
        return stream.getvalue().splitlines()[-1]

    assert shown(0, s0=["success"]).endswith(
        "1/6 trials  success 100.0 %  starting LeRobot and the simulators ..."
    )
    assert shown(200, s0=["success", "horizon"]) == "recovery    2/6 trials  success 50.0 %", "no pace yet"
    assert shown(290, s0=["success", "horizon", "horizon"]).endswith("about 4 min 30 s left")
    assert shown(400, s1=["success"] * 3).endswith("6/6 trials  success 66.7 %  done")


def test_progress_in_a_file_repeats_itself_only_now_and_then(dataset):
    counts = RunProgress("recovery", ["fake-push-left-000"], 3)
    now = [0.0]
    stream = io.StringIO()
    progress = ProgressLine("recovery", stream, lambda: now[0])
    for second in range(31):
        now[0] = float(second)
        counts.add(rows_of(dataset, {"fake-push-left-000": ["success"] * (second // 10)}))
        progress.show(counts)
    assert [line.split()[1] for line in stream.getvalue().splitlines()] == ["0/3", "1/3", "3/3"]
