"""Conversion of a synthetic release of the paper's size: time, memory, size, and time to open the result.

    python benchmarks/convert_release.py

Each measurement runs in a process of its own; opening is the best of three, without imports. On a busy
machine look at the CPU times. The records are random: none of the paper's data.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]

_MEASURED = """
import json, resource, sys, time
began, began_cpu = time.perf_counter(), time.process_time()
{code}
seconds, cpu = time.perf_counter() - began, time.process_time() - began_cpu
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(json.dumps({{"seconds": round(seconds, 2), "cpu_seconds": round(cpu, 2), "peak_bytes": peak}}))
"""

_CONVERT = """
import importlib.util
spec = importlib.util.spec_from_file_location("convert", {script!r})
convert = importlib.util.module_from_spec(spec); spec.loader.exec_module(convert)
assert convert.main([{release!r}, "--out", {out!r}]) == 0
"""

_OPEN = """
from lerobot_roborecover.datasets import load_scenarios
took = []
for _ in range(3):
    opened, cpu = time.perf_counter(), time.process_time()
    assert len(load_scenarios({dataset!r})) == {count}
    took.append((time.process_time() - cpu, time.perf_counter() - opened))
began, began_cpu = time.perf_counter() - min(t[1] for t in took), time.process_time() - min(took)[0]
"""


def measure(code: str) -> dict:
    command = [sys.executable, "-c", _MEASURED.format(code=code.strip())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(done.stderr)
    return json.loads(done.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("--scenarios", type=int, default=2000)
    parser.add_argument("--steps", type=int, default=200, help="prefix length of every record")
    args = parser.parse_args()
    sys.path.insert(0, str(ROOT))
    from tests.support.release_files import libero_record, write_release

    with tempfile.TemporaryDirectory() as folder:
        release, out = Path(folder) / "release", Path(folder) / "out"
        count = args.scenarios
        records = [libero_record(i, args.steps - 10) for i in range(count)]
        write_release(
            release, {"libero": {"train": records[: count * 4 // 5], "test": records[count * 4 // 5 :]}}
        )
        script = ROOT / "conversion" / "roborecover_release.py"
        converted = measure(_CONVERT.format(script=str(script), release=str(release), out=str(out)))
        dataset = out / "libero"
        opened = measure(_OPEN.format(dataset=str(dataset), count=count))
        size = sum(p.stat().st_size for p in (dataset / "meta" / "roborecover").iterdir())
    limits = {"convert_s": 60, "convert_peak_mb": 1000, "open_s": 1, "evaluation_part_mb": 40}
    found = {
        "convert_s": converted["seconds"],
        "convert_peak_mb": round(converted["peak_bytes"] / 1e6),
        "open_s": opened["seconds"],
        "evaluation_part_mb": round(size / 1e6, 1),
    }
    print(f"{count} scenarios, prefixes of {args.steps} actions")
    print(f"CPU seconds: convert {converted['cpu_seconds']}, open {opened['cpu_seconds']}")
    for name, value in found.items():
        print(f"{name:20} {value:>8} (limit {limits[name]}) {'ok' if value < limits[name] else 'MISSED'}")
    raise SystemExit(any(found[name] >= limits[name] for name in limits))


if __name__ == "__main__":
    main()
