# RoboTwin 2.0 on a machine with an NVIDIA GPU (docs/platforms.md). From the root of this repository:
#
#     docker build -f docker/robotwin.Dockerfile -t roborecover-robotwin .
#     docker run --rm --gpus all roborecover-robotwin roborecover doctor --platform robotwin
#     docker run --rm --gpus all -v "$PWD/outputs:/lerobot/outputs" roborecover-robotwin \
#         lerobot-eval --env roborecover_robotwin --policy.path=<RoboTwin checkpoint> \
#         --eval.n_episodes=5 --eval.batch_size=5 --output_dir=outputs/robotwin
#
# The host needs the NVIDIA Container Toolkit, and a driver that PyTorch's CUDA wheels run on. curobo is not in the
# image: joint actions do not need it. As LeRobot's images: /lerobot with a virtual environment, the user user_lerobot.
# The base is pinned by its digest.
FROM python:3.12.15-slim-bookworm@sha256:54c85f3c47607a77f32adec749d3c81d1348bf25833671f512b26a9b6d778cb3

# `graphics` has the toolkit mount the driver's Vulkan part as well.
ENV DEBIAN_FRONTEND=noninteractive \
    NVIDIA_VISIBLE_DEVICES=all \
    NVIDIA_DRIVER_CAPABILITIES=compute,utility,graphics \
    PATH=/lerobot/.venv/bin:$PATH

# Vulkan's loader and what the driver's Vulkan part and SAPIEN link with; FFmpeg for torchcodec.
COPY scripts/uv_requirements.txt /tmp/
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        ffmpeg g++ git libegl1 libgl1 libglvnd0 libvulkan1 libx11-6 libxext6 unzip \
    && rm -rf /var/lib/apt/lists/* \
    && pip install --no-cache-dir --only-binary :all: --require-hashes -r /tmp/uv_requirements.txt \
    && useradd --uid 1000 --create-home --shell /bin/bash user_lerobot \
    && mkdir /lerobot \
    && chown user_lerobot:user_lerobot /lerobot

USER 1000
WORKDIR /lerobot
ENV HOME=/home/user_lerobot \
    HF_HOME=/home/user_lerobot/.cache/huggingface \
    ROBOTWIN_ROOT=/home/user_lerobot/RoboTwin

# The commit that LeRobot 0.6.1 pins.
ARG ROBOTWIN_COMMIT=0aeea2d669c0f8516f4d5785f0aa33ba812c14b4
RUN git clone --no-checkout --filter=blob:none https://github.com/RoboTwin-Platform/RoboTwin "$ROBOTWIN_ROOT" \
    && git -C "$ROBOTWIN_ROOT" checkout "$ROBOTWIN_COMMIT"

COPY --chown=user_lerobot:user_lerobot . .
RUN uv venv --python 3.12 \
    && uv pip install --no-cache --compile-bytecode -c constraints.txt -e ".[robotwin]" \
    && mkdir -p outputs

# Robot and object models, some GB, held to their hashes. Background textures (11 GB) are for `demo_randomized` alone.
ARG ROBOTWIN_ASSETS_REVISION=981c92aa34d8f94d4cff47e0d5bc2f7d4e0af042
ARG EMBODIMENTS_SHA256=6b87d7d55e106d8ff25917e0538eb1e177fc549280e8a742a8cec3cb9f953fc6
ARG OBJECTS_SHA256=6aa56b3cf1e1064f7c809308144da36b00815f8b137fef2d7e4de856f8becf27
WORKDIR $ROBOTWIN_ROOT/assets
RUN hf download TianxingChen/RoboTwin2.0 embodiments.zip objects.zip --repo-type dataset \
        --revision "$ROBOTWIN_ASSETS_REVISION" --local-dir . \
    && echo "$EMBODIMENTS_SHA256  embodiments.zip" >sums \
    && echo "$OBJECTS_SHA256  objects.zip" >>sums \
    && sha256sum --check --strict sums \
    && unzip -q embodiments.zip \
    && unzip -q objects.zip \
    && rm -rf embodiments.zip objects.zip sums .cache

WORKDIR /lerobot
CMD ["roborecover", "doctor", "--platform", "robotwin"]
