# LIBERO on a machine with an NVIDIA GPU, with the policy families that LeRobot has. From the root of this repository:
#
#     docker build -f docker/libero.Dockerfile -t roborecover-libero .
#     docker run --rm --gpus all roborecover-libero         # roborecover doctor --platform libero
#     docker run --rm --gpus all -v "$PWD/outputs:/lerobot/outputs" roborecover-libero \
#         roborecover reproduce pi05_libero --set policy.device=cuda
#
# The host needs the NVIDIA Container Toolkit, and a driver that PyTorch's CUDA wheels run on. As LeRobot's images:
# /lerobot with a virtual environment, the user user_lerobot. The base is pinned by its digest.
FROM python:3.12.15-slim-bookworm@sha256:54c85f3c47607a77f32adec749d3c81d1348bf25833671f512b26a9b6d778cb3

# `graphics` has the toolkit mount the driver's EGL part as well.
ENV DEBIAN_FRONTEND=noninteractive \
    MUJOCO_GL=egl \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics \
    PATH=/lerobot/.venv/bin:$PATH

# What builds egl_probe, which LIBERO asks for and which has no wheels; OpenGL; FFmpeg for torchcodec.
COPY scripts/uv_requirements.txt /tmp/
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        cmake ffmpeg g++ git libegl1 libgl1 libglvnd0 make \
    && rm -rf /var/lib/apt/lists/* \
    && pip install --no-cache-dir --only-binary :all: --require-hashes -r /tmp/uv_requirements.txt \
    && useradd --uid 1000 --create-home --shell /bin/bash user_lerobot \
    && mkdir /lerobot \
    && chown user_lerobot:user_lerobot /lerobot

USER 1000
WORKDIR /lerobot
ENV HOME=/home/user_lerobot \
    HF_HOME=/home/user_lerobot/.cache/huggingface \
    ROBORECOVER_LIBERO_ASSETS=/home/user_lerobot/libero_assets \
    CMAKE_POLICY_VERSION_MINIMUM=3.5

COPY --chown=user_lerobot:user_lerobot . .
RUN uv venv --python 3.12 \
    && uv pip install --no-cache --compile-bytecode -c constraints.txt -e ".[libero,policies,remote]" \
    && mkdir -p outputs

# The commit that the package downloads (lerobot_roborecover/platforms/libero/assets.py).
ARG LIBERO_ASSETS_REVISION=0b3ea86be5fe169d0fd036ae63d1070ec09e90f6
RUN hf download lerobot/libero-assets --repo-type dataset --revision "$LIBERO_ASSETS_REVISION" \
        --local-dir "$ROBORECOVER_LIBERO_ASSETS" \
    && rm -rf "$ROBORECOVER_LIBERO_ASSETS/.cache"

CMD ["roborecover", "doctor", "--platform", "libero"]
