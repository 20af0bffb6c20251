"""UnifoLM-VLA on LIBERO behind openpi's protocol; `--policy.mapping=unifolm_vla` asks it.

In UnifoLM-VLA's own environment (`pip install websockets msgpack`), from its checkout, with LIBERO as
scripts/eval_scripts/run_eval_libero.sh sets it up:

    PYTHONPATH=. python /path/to/policies/servers/unifolm_vla_libero.py \
        --pretrained-path .../pytorch_model.pt --vlm-pretrained-path Unifolm-VLM-Base

Calls what experiments/LIBERO/eval_libero.py of unitreerobotics/unifolm-vla calls at ff6c39a. Its constants
are chosen by the word "libero" on the command line: keep this file's name.
"""

from __future__ import annotations

import argparse
import os

import numpy as np
from policy_server import serve

SIZE = 224
SUITES = ("libero_spatial", "libero_object", "libero_goal", "libero_10")


def statistics_by_instruction():
    """Which normalisation statistics an instruction takes: those of its suite."""
    from libero.libero import benchmark

    suites = {name: benchmark.get_benchmark_dict()[name]() for name in SUITES}
    return {
        suite.get_task(i).language: f"{name}_no_noops"
        for name, suite in suites.items()
        for i in range(suite.n_tasks)
    }


def load(pretrained_path, vlm_pretrained_path):
    """`infer` of a checkpoint."""
    from experiments.LIBERO.eval_libero import get_action_state
    from experiments.LIBERO.libero_utils import resize_image_for_policy
    from experiments.LIBERO.unifolm_vla_inference import Unifolm_VLA_Inference
    from unifolm_vla.rlds_dataloader.constants import NUM_ACTIONS_CHUNK

    keys = statistics_by_instruction()
    model = Unifolm_VLA_Inference(
        policy_ckpt_path=pretrained_path, image_size=[SIZE, SIZE], unnorm_key=f"{SUITES[0]}_no_noops",
        vlm_pretrained_path=vlm_pretrained_path,
    )  # fmt: skip
    statistics = {
        key: (
            Unifolm_VLA_Inference.get_action_stats(key, pretrained_path),
            Unifolm_VLA_Inference.get_state_stats(key, pretrained_path),
        )
        for key in set(keys.values())
    }

    def infer(request):
        model.unnorm_key = keys[request["instruction"]]
        model.action_norm_stats, model.state_norm_stats = statistics[model.unnorm_key]
        frames = [
            {
                "full_image": resize_image_for_policy(frame["full_image"], SIZE),
                "wrist_image": resize_image_for_policy(frame["wrist_image"], SIZE),
                "state": frame["state"],
            }
            for frame in request["observations"]
        ]
        actions = np.asarray(get_action_state(frames, request["instruction"], model), np.float32)
        return {"actions": actions[-NUM_ACTIONS_CHUNK:]}

    return infer


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--pretrained-path", required=True)
    parser.add_argument("--vlm-pretrained-path", required=True)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=8000)
    args = parser.parse_args()
    infer = load(args.pretrained_path, args.vlm_pretrained_path)
    serve(infer, {"policy": os.path.basename(args.pretrained_path)}, args.host, args.port)
