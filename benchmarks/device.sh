#!/usr/bin/env bash
# Build, test and measure on a bare machine that has an NVIDIA GPU, torch for it, and nvcc. Each call takes well under
# ten minutes. Nothing is downloaded: wheels of missing packages are read from folders .whl* of the repository.
#
#   benchmarks/device.sh test                      GPU tests, then the rasterizer's CPU tests
#   benchmarks/device.sh sanitize                  memcheck and racecheck of the GPU tests on small scenes
#   benchmarks/device.sh kernels [OPTION...]       python3 -m benchmarks.kernels.rasterizer OPTION...
#   benchmarks/device.sh accuracy                  python3 -m benchmarks.accuracy.oracle --times
#   benchmarks/device.sh train SCENE [OPTION...]   python3 full_eval.py --scenes SCENE OPTION...
#   benchmarks/device.sh ranks COUNT SCENE [PART...]
#                                                  training over COUNT GPUs; parts: tests, scene, steps, memory
#   benchmarks/device.sh run COMMAND...            any other command, after building the extensions
#
# Environment: GS_COMMIT, the commit measured, for a copy without git. OUT, a folder for logs and the built wheels; put
# the wheels back as build/device/wheels to reuse them while the sources do not change.
set -euo pipefail
cd "$(dirname "$0")/.."

mode=${1:?test, sanitize, kernels, accuracy, train, ranks or run}
shift
out=${OUT:-build/device/out}
site=$PWD/build/device/site
mkdir -p "$out" "$site"
export PYTHONPATH=$site PYTHONUNBUFFERED=1 PATH=$PATH:${CUDA_HOME:-/usr/local/cuda}/bin
export MAX_JOBS=${MAX_JOBS:-$(nproc)}

say() { printf '\n== %s (%d s)\n' "$1" "$SECONDS"; }

# Install wheels of missing packages; keep every version that is installed.
install_missing() {
  local wheels
  wheels=$(python3 - .whl*/*.whl << 'PYTHON'
import importlib.metadata
import sys
from pathlib import Path

found = {}
for wheel in map(Path, sys.argv[1:]):
    name = wheel.name.split("-")[0]
    try:
        importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        if wheel.is_file():
            found[name] = wheel
print(*found.values(), sep="\n")
PYTHON
  )
  [ -z "$wheels" ] || pip_install $wheels
}

pip_install() {
  python3 -m pip install --quiet --no-index --no-deps --no-compile --no-cache-dir --upgrade --target "$site" "$@"
}

# Build the three extensions as one wheel, in a folder named by a hash of everything it depends on.
build() {
  export GS_CUDA=1
  TORCH_CUDA_ARCH_LIST=${TORCH_CUDA_ARCH_LIST:-$(python3 -c \
    'import torch; print("{}.{}".format(*torch.cuda.get_device_capability()))')}
  export TORCH_CUDA_ARCH_LIST
  local key wheels new
  key=$( (
    echo "$TORCH_CUDA_ARCH_LIST ${NVCC_APPEND_FLAGS:-}"
    cat version.txt setup.py requirements.txt
    find submodules -type f \( -name '*.py' -o -name '*.toml' -o -name '*.h' -o -name '*.cpp' -o -name '*.cu*' \) \
      -not -path '*/build/*' -print0 | LC_ALL=C sort -z | xargs -0 sha256sum
  ) | sha256sum | cut -c1-16)
  wheels=build/device/wheels/$key
  if [ ! -d "$wheels" ]; then
    new=$(mktemp -d build/device/new.XXXX)
    python3 -m pip wheel --quiet --no-index --no-deps --no-build-isolation --no-cache-dir -w "$new" .
    mkdir -p build/device/wheels
    mv "$new" "$wheels"
  fi
  pip_install "$wheels"/*.whl
  # Fail here: tests would silently skip missing kernels.
  python3 - << 'PYTHON'
import sys

import diff_gaussian_rasterization
import fused_ssim
import simple_knn._C
import torch

ops = ("diff_gaussian_rasterization::rasterize", "fused_ssim::l1_ssim", "simple_knn::mean_distance2")
missing = [op for op in ops if not torch._C._dispatch_has_kernel_for_dispatch_key(op, "CUDA")]
if missing:
    sys.exit(f"built without CUDA: {', '.join(missing)}")
PYTHON
  if [ -n "${OUT:-}" ]; then
    mkdir -p "$OUT/wheels/$key"
    cp "$wheels"/*.whl "$OUT/wheels/$key"
  fi
}

describe() {
  nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader
  nvcc --version | tail -n 2 | head -n 1
  python3 - << 'PYTHON'
import importlib.metadata
import platform

names = "torch numpy scipy pillow tqdm plyfile scikit-image lpips pycolmap pytest hypothesis setuptools ninja"
versions = [f"Python {platform.python_version()}"]
for name in names.split():
    try:
        versions.append(f"{name} {importlib.metadata.version(name)}")
    except importlib.metadata.PackageNotFoundError:
        versions.append(f"{name} -")
print(", ".join(versions))
PYTHON
  echo "commit ${GS_COMMIT:-$(git rev-parse --short HEAD 2> /dev/null || echo 'not known (GS_COMMIT is not set)')}"
}

test_all() {
  local gpu status=0
  gpu=$(grep -rlE --include='test_*.py' 'mark\.gpu|GPU_MARKS|_AND_GPU' tests applications/*/tests benchmarks/tests)
  say "tests on the GPU"
  python3 -m pytest -q -p no:cacheprovider -m gpu $gpu || status=1
  say "tests of the rasterizer on the CPU"
  python3 -m pytest -q -p no:cacheprovider -m 'not gpu' tests/test_rasterizer_*.py || status=1
  return $status
}

# Switch torch's memory pool off, or an access beyond an allocation would hit a neighbour and go unnoticed.
sanitize() {
  local tool gpu status=0
  gpu=$(grep -rlE --include='test_*.py' 'mark\.gpu|GPU_MARKS|_AND_GPU' tests applications/*/tests benchmarks/tests)
  for tool in memcheck racecheck; do
    say "$tool"
    PYTORCH_NO_CUDA_MEMORY_CACHING=1 timeout 270 compute-sanitizer --tool "$tool" --error-exitcode 9 \
      --print-limit 20 python3 -m pytest -q -x -p no:cacheprovider -m gpu \
      -k 'test_sizes or small_clouds or agrees_with_the_cpu' $gpu || status=1
  done
  return $status
}

# Run a command for at most so many seconds, and end before a call of ten minutes does.
part() {
  local limit=$1 name=$2 left=$((575 - SECONDS))
  shift 2
  [ "$left" -ge 20 ] || { say "$name: left out, no time is left" && return 1; }
  [ "$limit" -le "$left" ] || limit=$left
  say "$name (at most $limit s)"
  timeout --kill-after 15 "$limit" "$@" || { say "$name: failed with status $?" && return 1; }
}

ranks() {
  local count=$1 scene=$2 name models ranks status=0
  local steps=(python3 -m benchmarks.parallel.steps)
  shift 2
  # One host: gloo needs no network.
  export GLOO_SOCKET_IFNAME=${GLOO_SOCKET_IFNAME:-lo} NCCL_DEBUG=${NCCL_DEBUG:-WARN}
  nvidia-smi topo -m || true
  [ $# -gt 0 ] || set -- tests scene steps memory
  for name in "$@"; do
    case $name in
      tests)
        part 170 "tests of ranks" python3 -m pytest -q -p no:cacheprovider -m gpu --durations=0 \
          tests/test_ranks_gpu.py || status=1
        ;;
      scene)
        models=$(mktemp -d build/device/models.XXXX)
        for ranks in 1 "$count"; do
          part 75 "a scene by $ranks ranks" torchrun --standalone --nproc_per_node "$ranks" train.py -s "$scene" \
            -m "$models/$ranks" --eval --iterations 7000 --no_curve --disable_viewer --quiet || status=1
          tail -n 20 "$models/$ranks/train_log.json" && sha256sum "$models/$ranks"/point_cloud/*/point_cloud.ply || status=1
        done
        ;;
      steps)
        part 210 "steps by ranks" "${steps[@]}" --ranks 1 "$count" --limit 75 || status=1
        ;;
      memory)
        part 150 "memory of ranks" "${steps[@]}" --ranks 1 "$count" --workload city \
          --gaussians 5000000 20000000 --blocks 1 --rounds 1 || status=1
        ;;
      *) say "no part is named $name" && status=2 ;;
    esac
  done
  return $status
}

describe
say "missing packages"
install_missing
say "build"
build
{
  case $mode in
    test) test_all ;;
    sanitize) sanitize ;;
    kernels)
      say "kernels"
      python3 -m benchmarks.kernels.rasterizer --device cuda "$@"
      ;;
    accuracy)
      say "errors and run times"
      python3 -m benchmarks.accuracy.oracle --times
      ;;
    train)
      scene=${1:?a scene}
      shift
      say "training on $scene"
      python3 full_eval.py --scenes "$scene" --output_path "$(mktemp -d build/device/models.XXXX)" "$@"
      ;;
    ranks) ranks "${1:?a number of GPUs}" "${2:?a scene}" "${@:3}" ;;
    run) "$@" ;;
    *) echo "device.sh: unknown mode $mode" >&2 && exit 2 ;;
  esac
  say "done"
} 2>&1 | tee "$out/$mode.log"
