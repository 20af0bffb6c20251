"""The commands of `roborecover`, in groups, and the names that some of them had before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Command:
    """One command."""

    name: str
    """As it is typed after `roborecover`, e.g. `curate split`."""
    module: str
    """In this folder, or `module:NAME` of an object in one, with `HELP`, `OPTIONS` (the command's dataclass)
    and `run(options) -> exit status`. Where another parser reads the arguments: with `HELP` and
    `pass_through(argv) -> exit status`."""
    summary: str
    """One line for the lists of commands."""
    old: str = ""
    """Flat name that it had before, which still works."""

    @property
    def group(self) -> str:
        """Empty for a command at the top."""
        return self.name.rpartition(" ")[0]

    @property
    def word(self) -> str:
        return self.name.rpartition(" ")[2]


GROUPS = {
    "dataset": "Scenario datasets: look into them, move them to and from the Hub.",
    "curate": "Make scenarios, and training data, from rollouts.",
    "detect": "Monitors and failure detectors: their data, their measures, when to intervene.",
    "robot": "Real robots: back to a recovery point, and compare policies from there.",
    "check": "Check a policy or a platform before hours are spent on it.",
}

COMMANDS = (
    Command("demo", "demo", "Evaluate the shipped policy on the shipped scenarios."),
    Command("doctor", "doctor", "Check what this machine has and lacks."),
    Command("plan", "plan", "Plan how many scenarios and trials a comparison needs."),
    Command("eval", "config_command:EVAL", "Evaluate a policy; takes lerobot-eval's options and --runner.*."),
    Command("report", "report", "Turn trial logs into tables, figures and one HTML page."),
    Command("compare", "compare", "Compare two policies from their trial logs."),
    Command("leaderboard", "leaderboard", "Make a leaderboard from trial logs; offer results to the Hub."),
    Command("serve", "config_command:SERVE", "Serve a LeRobot policy over openpi's websocket protocol."),
    Command("reproduce", "reproduce", "Reproduce a published score, then measure recovery."),
    Command("merge", "merge", "Join the trial logs of shards."),
    Command("export-ema", "export_ema", "Write a training run's averaged weights as a checkpoint."),
    Command("dataset inspect", "inspect", "Show what a dataset holds; replay one scenario.", "inspect"),
    Command(
        "dataset pull", "dataset:PULL", "Pull a dataset from the Hub into a new folder, checked.", "pull"
    ),
    Command("dataset publish", "publish", "Publish a dataset on the Hub, with its card and tags.", "publish"),
    Command("dataset render", "render", "Render every prefix as an episode of a LeRobotDataset.", "render"),
    Command("dataset repair", "dataset:REPAIR", "Rebuild the metadata after LeRobot's tools.", "repair"),
    Command("dataset certify", "certify", "Replay every scenario; certify what is exact."),
    Command("dataset envhub", "dataset:ENVHUB", "Write an EnvHub repository that offers a set.", "envhub"),
    Command("curate build", "build", "Build a scenario dataset from one YAML file.", "build"),
    Command("curate collect", "collect", "Roll out a policy or an expert; keep its failures.", "collect"),
    Command("curate teleop", "teleop", "Drive a simulator in the browser, and recover.", "teleop"),
    Command("curate annotate", "annotate", "Mark recovery points in a local web page.", "annotate"),
    Command("curate agree", "agree", "Measure agreement; resolve votes to scenarios.", "agree"),
    Command("curate screen", "screen", "Keep the scenarios of intermediate difficulty.", "screen"),
    Command("curate validate", "validate", "Keep the scenarios that replay exactly.", "validate"),
    Command("curate split", "split", "Divide a dataset into splits without leakage.", "split"),
    Command("curate donors", "donors", "Make Correction's training data.", "donors"),
    Command(
        "curate training-data", "export_training", "Make a dataset for lerobot-train from trials.",
        "export-training",
    ),
    Command("detect data", "monitor_data", "Make the labelled frames of a monitor.", "monitor-data"),
    Command("detect evaluate", "detect_evaluate", "Compare detectors on a policy's own trials."),
    Command("detect evaluate-frames", "detect_evaluate_frames", "Measure a monitor on labelled frames."),
    Command("detect fork", "fork", "Continue logged trials in several ways: counterfactuals.", "fork"),
    Command("robot capture", "config_command:CAPTURE", "Run a policy, record it, mark where it goes wrong."),
    Command("robot points", "robot:POINTS", "Make recovery points of recorded episodes."),
    Command("robot restore", "config_command:RESTORE", "Put robot and scene back; measure how far off."),
    Command("robot run", "config_command:RUN_PLAN", "Run a plan of points and policies, blind."),
    Command("robot rate", "robot:RATE", "Rate recorded trials a second time, blind."),
    Command("robot fieldtrial", "robot:FIELDTRIAL", "Let fieldtrial schedule and label the trials."),
    Command("check policy", "config_command:CHECK_POLICY", "Try a policy for a few steps.", "check-policy"),
    Command("check platform", "check_platform", "Check that states are rebuilt exactly.", "check-platform"),
)  # fmt: skip

SPLIT_NAMES = {"eval-monitor": ("eval_monitor", ("detect evaluate", "detect evaluate-frames"))}
"""Old names that are two commands now: the module that still takes the options of both, and the two."""

OUTSIDE = {"study": "python -m recipes.study"}
"""Old names that are no commands of the package now, each a module in this folder; what to run in a clone."""


@dataclass(frozen=True)
class Call:
    """A command that was found in a command line."""

    name: str
    """As it was typed."""
    module: str
    rest: tuple[str, ...]
    """The arguments after its name."""
    note: str = ""
    """What to say of an old name."""


def in_group(group: str) -> list[Command]:
    """The commands of a group; of the top where it is empty."""
    return [command for command in COMMANDS if command.group == group]


def find_call(argv: Sequence[str]) -> Call | None:
    """Finds the command that a command line names.

    Args:
        argv: arguments after the program's name.

    Returns:
        None where it names no command.
    """
    for command in COMMANDS:
        words = command.name.split()
        if list(argv[: len(words)]) == words:
            return Call(command.name, command.module, tuple(argv[len(words) :]))
    name = argv[0] if argv else ""
    if name in SPLIT_NAMES:
        module, now = SPLIT_NAMES[name]
        names = " and ".join(f'"roborecover {command}"' for command in now)
        return Call(name, module, tuple(argv[1:]), _note(name, names))
    if name in OUTSIDE:
        return Call(name, name, tuple(argv[1:]), _note(name, f'"{OUTSIDE[name]}"'))
    for command in COMMANDS:
        if command.old and command.old == name:
            return Call(name, command.module, tuple(argv[1:]), _note(name, f'"roborecover {command.name}"'))
    return None


def _note(old: str, now: str) -> str:
    return f'note: "roborecover {old}" is now {now}'


def nearest_name(word: str, group: str = "") -> str:
    """Returns the command or group whose name is most like a word; empty where none is.

    Args:
        word: what was typed in the place of a command.
        group: the group that it was typed in; its commands come first.
    """
    from difflib import get_close_matches

    names: dict[str, str] = {}
    for command in COMMANDS:
        names.setdefault(command.old, command.name)
        names.setdefault(command.word, command.name)
    for old, (_, now) in SPLIT_NAMES.items():
        names[old] = now[0]
    names |= {name: name for name in GROUPS}
    names |= {command.name: command.name for command in in_group("")}
    names["evaluate"] = "eval"  # and not `detect evaluate`
    inside = {command.word: command.name for command in in_group(group)} if group else {}
    for known in (inside, names):
        for name in get_close_matches(word, known, 1):
            return known[name]
    return ""


def overview() -> str:
    """What `roborecover --help` prints: every command, on one screen of 80 columns."""
    lines = [
        "usage: roborecover COMMAND ...",
        "",
        "Measure, and improve, how robot policies recover. Begin with: roborecover demo",
        "",
    ]
    lines += [f"  {command.name:<11}  {command.summary}" for command in in_group("")] + [""]
    for group in GROUPS:
        lines += _wrapped(f"  {group:<11}  ", [command.word for command in in_group(group)])
    lines += ["", "roborecover COMMAND --help lists options; --version is the version."]
    return "\n".join(lines) + "\n"


def group_help(group: str) -> str:
    """What `roborecover GROUP --help` prints."""
    commands = in_group(group)
    width = max(len(command.word) for command in commands)
    lines = [f"usage: roborecover {group} COMMAND ...", "", GROUPS[group], ""]
    lines += [f"  {command.word:<{width}}  {command.summary}" for command in commands]
    lines += ["", f"roborecover {group} COMMAND --help lists options."]
    return "\n".join(lines) + "\n"


def _wrapped(head: str, words: Sequence[str], width: int = 80) -> list[str]:
    lines = [head + words[0]]
    for word in words[1:]:
        if len(lines[-1]) + len(word) + 5 > width:
            lines[-1] += " |"
            lines.append(" " * len(head) + word)
        else:
            lines[-1] += f" | {word}"
    return lines
