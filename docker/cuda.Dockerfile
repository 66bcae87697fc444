# Training, rendering and scoring on an NVIDIA GPU. The host needs a driver for CUDA 13 and NVIDIA's container toolkit.
#
#   docker build --file docker/cuda.Dockerfile --tag gaussian-splatting:cuda .
#   docker run --rm --gpus all gaussian-splatting:cuda doctor.py
FROM nvidia/cuda:13.0.1-devel-ubuntu24.04 AS build

# The compilers stay in this stage. Versions are those of the base image's release.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ python3 python3-venv \
    && rm -rf /var/lib/apt/lists/*

ENV PATH=/opt/venv/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cu130
WORKDIR /build
COPY requirements.txt ./
RUN python3 -m venv /opt/venv && pip install "setuptools==84.2.1" -r requirements.txt
COPY version.txt ./
COPY submodules submodules
# No GPU is visible here, so the architectures are named; PTX serves newer ones.
ENV GS_CUDA=1 CUDA_HOME=/usr/local/cuda TORCH_CUDA_ARCH_LIST="7.5;8.0;8.6;8.9;9.0;10.0;12.0+PTX"
RUN pip install --no-deps --no-build-isolation \
    ./submodules/simple-knn ./submodules/fused-ssim ./submodules/diff-gaussian-rasterization

# torch's packages bring the CUDA libraries, so the toolkit is not needed here.
FROM ubuntu:24.04

# Ubuntu's image has a user 1000 already, who is not root.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends python3 \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/venv /opt/venv
WORKDIR /app
COPY . .
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
ENV NVIDIA_VISIBLE_DEVICES=all NVIDIA_DRIVER_CAPABILITIES=compute,utility
USER 1000:1000
ENTRYPOINT ["python"]
CMD ["doctor.py"]
