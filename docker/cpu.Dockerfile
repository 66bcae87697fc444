# Training, rendering and scoring on a CPU.
#
#   docker build --file docker/cpu.Dockerfile --tag gaussian-splatting:cpu .
#   docker run --rm gaussian-splatting:cpu doctor.py
FROM python:3.12-slim-bookworm AS build

# The compiler stays in this stage. Its version is that of the base image's release.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++ \
    && rm -rf /var/lib/apt/lists/*

ENV PATH=/opt/venv/bin:$PATH PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
WORKDIR /build
COPY requirements.txt ./
RUN python -m venv /opt/venv && pip install "setuptools==84.2.1" -r requirements.txt
COPY version.txt ./
COPY submodules submodules
RUN pip install --no-deps --no-build-isolation \
    ./submodules/simple-knn ./submodules/fused-ssim ./submodules/diff-gaussian-rasterization

FROM python:3.12-slim-bookworm

RUN useradd --create-home --uid 1000 splats
COPY --from=build /opt/venv /opt/venv
WORKDIR /app
COPY . .
ENV PATH=/opt/venv/bin:$PATH PYTHONUNBUFFERED=1 PYTHONDONTWRITEBYTECODE=1
USER 1000:1000
ENTRYPOINT ["python"]
CMD ["doctor.py"]
