"""`roborecover doctor`: what evaluation and scores need on this machine, checked and left as it is."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

from lerobot_roborecover.doctor.machine import check_cores, check_disk, check_gpu, check_opengl
from lerobot_roborecover.doctor.software import (
    check_ffmpeg,
    check_opencv,
    check_plugin,
    check_python,
    check_versions,
)
from lerobot_roborecover.doctor.sources import check_hub, recorded_by
from lerobot_roborecover.platforms import all_platforms, platform_named
from lerobot_roborecover.platforms.findings import Check, Status, format_report, report_json
from lerobot_roborecover.platforms.probe import run_probe

_LEROBOT_TIMEOUT_S = 180.0

__all__ = ["Check", "Status", "examine", "format_report", "report_json"]


def examine(platform: str = "all") -> list[Check]:
    """Runs every check.

    Args:
        platform: a platform, whose packages and assets are then required; or `all`, where what is not
            installed is a warning.
    """
    required = platform != "all"
    wanted = (
        [platform_named(platform).resolve(())]
        if required
        else [p for p in all_platforms() if p.required_versions]
    )
    with ThreadPoolExecutor() as pool:
        # The slow ones wait for a process or for the network, and go on side by side.
        lerobot = pool.submit(run_probe, "doctor.probe_lerobot", timeout_s=_LEROBOT_TIMEOUT_S)
        opengl = pool.submit(check_opengl)
        hub = pool.submit(check_hub)
        assets = [pool.submit(lambda p: p.examine(required, recorded_by(p)), p) for p in wanted]
        checks = [check_python()]
        seen = set()
        for found in wanted:
            for check in check_versions(found.name, required):
                package = check.name.rpartition(": ")[2]
                if package not in seen or check.status is not Status.OK:
                    checks.append(check)
                seen.add(package)
        probe = lerobot.result()
        checks += [check_plugin(probe), check_opencv(probe), check_ffmpeg(probe), opengl.result()]
        checks += [check for part in assets for check in part.result()]
        checks += [hub.result(), check_gpu(probe), check_cores(), check_disk()]
    return checks
