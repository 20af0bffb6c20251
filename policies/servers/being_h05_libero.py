"""Being-H0.5 on LIBERO behind openpi's protocol; `--policy.mapping=being_h05` asks it.

In Being-H's own environment (`pip install websockets msgpack`), from its checkout:

    PYTHONPATH=. python /path/to/policies/servers/being_h05_libero.py --model-path Being-H05-2B_libero

Loads the policy as scripts/eval/eval-libero.sh of BeingBeyond/Being-H does at 594219e.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from policy_server import serve

TEMPLATE = (
    "According to the instruction '{task_description}', what's the micro-step actions in the next {k} steps?"
)
ACTIONS = ("action.eef_position", "action.eef_rotation", "action.gripper_position")


def load(model_path):
    """`infer` of a checkpoint."""
    import torch
    from BeingH.inference.beingh_policy import BeingHPolicy

    torch.manual_seed(42)
    policy = BeingHPolicy(
        model_path=model_path, data_config_name="libero_nonorm", dataset_name="libero_posttrain",
        embodiment_tag="libero", instruction_template=TEMPLATE, prop_pos="front", max_view_num=-1,
        use_fixed_view=False, device="cuda" if torch.cuda.is_available() else "cpu", enable_rtc=False,
    )  # fmt: skip

    def infer(request):
        chunk = policy.get_action(request)
        actions = np.concatenate([np.asarray(chunk[key], np.float32) for key in ACTIONS], axis=-1)
        return {"actions": actions.reshape(-1, actions.shape[-1])}

    return infer


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--model-path", required=True)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    args = parser.parse_args()
    serve(load(args.model_path), {"policy": os.path.basename(args.model_path)}, args.host, args.port)
