"""A person at the page as the interventions' driver: `--policy.mode=human
--policy.controller=lerobot_roborecover.web.teleop.takeover:controller`.

The page shows what the policy sees, the person drives one step at a time until they hand back. Here the
evaluation waits for the person, so that its own thread asks the pilot; there is no simulator of ours.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lerobot_roborecover.errors import OptionError
from lerobot_roborecover.platforms import Platform, all_platforms
from lerobot_roborecover.platforms.controls import AXES, Controls
from lerobot_roborecover.web.serve import HOST, kept_tokens, listen, make_server, own_hosts
from lerobot_roborecover.web.teleop.hub import Hub
from lerobot_roborecover.web.teleop.pilot import InputHandler, OperatorCommand, Tick, most_unseen
from lerobot_roborecover.web.teleop.status import encode

if TYPE_CHECKING:
    import torch

PORT_VARIABLE = "ROBORECOVER_TAKEOVER_PORT"
DEFAULT_PORT = 8733
FPS = 15.0
"""Pictures a second at which a person drives in real time."""
_STATE, _IMAGES = "observation.state", "observation.image"


@dataclass
class TakeoverSlot:
    instruction: str
    controls: Controls | None = None
    step: int = 0


class Takeover:
    """An `policies.interventions.takeover.TakeoverController`.

    Args:
        port: of the page; 0 takes a free one.

    Raises:
        ScenarioError: the port is taken.
    """

    def __init__(self, port: int = DEFAULT_PORT):
        from lerobot_roborecover.web.teleop.server import NAME, TeleopApp, make_app

        self._hub, self._pilot = Hub(), InputHandler(20.0, 20.0)
        self._slot: TakeoverSlot | None = None
        self._problem = ""
        self._taken = 0
        listener = listen(port)
        port = listener.getsockname()[1]
        token = kept_tokens("takeover", Path.cwd(), ["driver"])["driver"]
        self.address = f"http://{HOST}:{port}/{NAME}/?token={token}"
        self._publish()
        app = make_app(TeleopApp(token, own_hosts(port), self._hub, self._pilot))
        server = threading.Thread(
            target=make_server(app).run, kwargs={"sockets": [listener]}, name="takeover", daemon=True
        )
        server.start()
        print(f"takeovers are driven at {self.address}", file=sys.stderr, flush=True)

    def take(self, instruction: str) -> TakeoverSlot:
        """See `TakeoverController.take`.

        Raises:
            OptionError: another slot is being driven.
        """
        if self._slot is not None:
            raise OptionError(
                "a person drives one simulator at a time: --eval.batch_size=1, and for roborecover eval "
                "--runner.slots=1. Finished trials are in the log; the same command goes on after them"
            )
        self._slot = TakeoverSlot(instruction)
        print(f"a person is needed: {instruction}  {self.address}", file=sys.stderr, flush=True)
        return self._slot

    def act(self, slot: TakeoverSlot, observation: Mapping[str, torch.Tensor]) -> np.ndarray | None:
        """See `TakeoverController.act`; waits for the person."""
        if slot.controls is None:
            self._begin(slot, observation)
        assert slot.controls is not None
        self._publish()
        shown = False
        while True:
            if not shown and self._hub.wants_pictures():
                self._hub.show(slot.step, _pictures(observation), self._taken)
                shown = True
            # A page that was opened just now asks for what is shown already.
            # The robot waits until the operator has seen the latest images.
            paused = self._hub.unseen(self._taken) >= most_unseen(self._pilot.rate_hz, FPS)
            event = self._pilot.poll(0.2 if shown and not paused else 0.02, paused=paused)
            if isinstance(event, Tick):
                slot.step, self._taken = slot.step + 1, self._taken + 1
                return slot.controls.action(event.axes, event.closed).astype(np.float32)
            if isinstance(event, OperatorCommand) and self._answer(event):
                return None

    def leave(self, slot: TakeoverSlot) -> None:
        self._slot = None
        self._pilot.let_go()
        self._publish()

    def _begin(self, slot: TakeoverSlot, observation: Mapping[str, torch.Tensor]) -> None:
        platform = _platform_of(observation)
        slot.controls = platform.controls()
        self._pilot.rate_hz = self._pilot.control_hz = platform.control_hz
        while (early := self._pilot.poll(0.0, drive=False)) is not None:
            if isinstance(early, OperatorCommand):
                early.reply({"ok": False, "message": "there was nothing to drive yet"})
        self._pilot.let_go()
        # A takeover must not drop the object that the policy holds.
        self._pilot.closed = platform.gripper_closed(observation[_STATE].detach().cpu().numpy())

    def _answer(self, command: OperatorCommand) -> bool:
        """Answers a command; True where the slot is handed back."""
        self._problem = ""
        good, back = True, command.kind == "hand_back"
        if command.kind == "gripper":
            self._pilot.toggle_gripper()
        elif command.kind == "realtime":
            self._pilot.realtime = bool(command.values.get("on"))
        elif command.kind not in ("hand_back", "status"):
            good = False
        status = self._publish()
        answer = {"ok": good, "status": status}
        if not good:
            answer["message"] = f"a takeover records nothing, and takes no {command.kind!r}; H hands back"
        command.reply(answer)
        return back

    def _publish(self) -> dict[str, Any]:
        slot = self._slot
        status: dict[str, Any] = {
            "type": "status",
            "mode": "takeover",
            "under_way": slot is not None,
            "closed": self._pilot.closed,
            "realtime": self._pilot.realtime,
            "rate_hz": self._pilot.rate_hz,
            "problem": self._problem,
        }
        if slot is not None:
            controls = slot.controls
            status |= {
                "instruction": slot.instruction,
                "label": "takeover",
                "step": slot.step,
                "first_step": 0,
            }
            if controls is not None:
                status |= {
                    "platform": controls.platform,
                    "axes": [a for a in AXES if a in controls.columns],
                    "gripper": controls.gripper is not None,
                }
        self._hub.publish(status)
        return status


def controller() -> Takeover:
    """What `--policy.controller` names.

    Raises:
        OptionError: the port is no number.
    """
    text = os.environ.get(PORT_VARIABLE, str(DEFAULT_PORT))
    if not text.isdecimal():
        raise OptionError(f"{PORT_VARIABLE}={text!r:.40} is no port; leave it out, or 0 takes a free one")
    return Takeover(int(text))


def _platform_of(observation: Mapping[str, torch.Tensor]) -> Platform:
    """Whose observation it is.

    Raises:
        OptionError: no platform knows it.
    """
    shapes = {key: tuple(value.shape) for key, value in observation.items()}
    for platform in all_platforms():
        if platform.owns_observation(shapes):
            return platform
    raise OptionError(
        "the observation has no robot state that says which platform it is "
        f"({_STATE}: {shapes.get(_STATE, 'none')}); use --env.obs_type=pixels_agent_pos"
    )


def _pictures(observation: Mapping[str, torch.Tensor]) -> dict[str, bytes]:
    found = {k: v for k, v in observation.items() if k.startswith(_IMAGES) and v.ndim == 3}
    arrays = {k: np.rint(v.detach().cpu().numpy().transpose(1, 2, 0) * 255) for k, v in found.items()}
    return {k: encode(a.clip(0, 255).astype(np.uint8)) for k, a in arrays.items()}


driver = controller
"""The function's earlier name, which configurations may hold."""
