"""How long a key in the gallery's filter takes on a report's page in Chromium, to the next frame.

python benchmarks/filter_speed.py [--scenarios 2000] [--policies 5]
"""

from __future__ import annotations

import argparse
import statistics
import sys
import tempfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

_TYPE = """async (text) => {
  const input = document.getElementById("filter-text");
  const start = performance.now();
  input.value = text;
  input.dispatchEvent(new Event("input"));
  await new Promise((drawn) => requestAnimationFrame(() => setTimeout(drawn, 0)));
  return performance.now() - start;
}"""
_KEYS = ("s", "s1", "s19", "s1", "s", "", "bowl", "none of them", "", "s000", "")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scenarios", type=int, default=2000)
    parser.add_argument("--policies", type=int, default=5)
    args = parser.parse_args()
    from lerobot_roborecover.analysis.analyse import analyse
    from lerobot_roborecover.analysis.logs import read_study
    from lerobot_roborecover.analysis.options import Options
    from lerobot_roborecover.analysis.pages.report import write_report
    from tests.support.browser import open_page
    from tests.support.trial_rows import policy_rows, write_log

    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        rows = [r for k in range(args.policies) for r in policy_rows(f"p{k}", args.scenarios, 5, 0.5, k)]
        study = read_study([str(write_log(root / "log.jsonl", rows))])
        page_file = write_report(analyse(study, Options(draws=100)), root / "out").html
        with open_page(page_file, root / "profile") as (page, _):
            page.evaluate("document.getElementById('scenarios').scrollIntoView()")
            took = [page.evaluate(_TYPE, key) for key in _KEYS]
    print(
        f"{args.scenarios} scenarios: median {statistics.median(took):.0f} ms, most {max(took):.0f} ms a key"
    )


if __name__ == "__main__":
    main()
