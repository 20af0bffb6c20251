# RoboTwin 2.0 on a machine with an NVIDIA GPU (docs/robotwin.md). From the root of this repository:
#
#     docker build -f docker/robotwin.Dockerfile -t roborecover-robotwin .
#     docker run --rm --gpus all roborecover-robotwin roborecover doctor --platform robotwin
#     docker run --rm --gpus all -v "$PWD/outputs:/outputs" roborecover-robotwin \
#         lerobot-eval --env roborecover_robotwin --policy.path=<RoboTwin checkpoint> \
#         --eval.n_episodes=5 --eval.batch_size=5 --output_dir=/outputs/robotwin
#
# The host needs the NVIDIA Container Toolkit, and a driver that PyTorch's CUDA wheels run on. curobo is not in the
# image: joint actions do not need it.
FROM python:3.12.15-slim-bookworm@sha256:54c85f3c47607a77f32adec749d3c81d1348bf25833671f512b26a9b6d778cb3

# `graphics` has the toolkit mount the driver's Vulkan part as well.
ENV NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics

# Vulkan's loader and what the driver's Vulkan part and SAPIEN link with; FFmpeg for torchcodec.
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ffmpeg g++ git libegl1 libgl1 libglvnd0 libvulkan1 libx11-6 libxext6 unzip \
    && rm -rf /var/lib/apt/lists/*

RUN pip install --no-cache-dir uv==0.13.9

# The commit that LeRobot 0.6.1 pins.
ARG ROBOTWIN_COMMIT=0aeea2d669c0f8516f4d5785f0aa33ba812c14b4
ENV ROBOTWIN_ROOT=/opt/RoboTwin
RUN git clone --no-checkout --filter=blob:none https://github.com/RoboTwin-Platform/RoboTwin "$ROBOTWIN_ROOT" \
    && git -C "$ROBOTWIN_ROOT" checkout "$ROBOTWIN_COMMIT"

WORKDIR /opt/roborecover
COPY . .
# In the system's Python: the image holds nothing else. uv reads pyproject.toml's overrides here.
RUN uv pip install --system --no-cache -c constraints.txt -e ".[robotwin]"

# Robot and object models, some GB. Background textures (11 GB) are for `demo_randomized` alone: add background_texture.
WORKDIR $ROBOTWIN_ROOT/assets
RUN for archive in embodiments objects; do \
        hf download TianxingChen/RoboTwin2.0 "$archive.zip" --repo-type dataset --local-dir . \
        && unzip -q "$archive.zip" && rm "$archive.zip" || exit 1; \
    done \
    && rm -rf .cache

WORKDIR /opt/roborecover
CMD ["roborecover", "doctor", "--platform", "robotwin"]
