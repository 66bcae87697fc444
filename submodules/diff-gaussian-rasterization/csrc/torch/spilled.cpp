// The ops of spilled tensors: of a GPU, with a first part in its memory and the rest in the host's, at one range of
// addresses.
#include <algorithm>
#include <limits>

#include "tensors.h"

#ifdef GS_CUDA
#include <cuda.h>

#include <map>
#include <mutex>

#include "gs/cuda_check.h"

// In torch from 2.11 on.
extern "C" __attribute__((weak)) AOTITorchError torch_from_blob(
    void* data, int64_t axes, const int64_t* sizes, const int64_t* strides, int64_t offset, int32_t dtype,
    int32_t device_type, int32_t device_index, AtenTensorHandle* made, int32_t layout, const uint8_t* metadata,
    int64_t metadata_size, void (*release)(void* data, void* context), void* context);
#endif

namespace gs::ops {

namespace {

void check_rows(const Tensor& values, const char* name) {
  check_given(values, name);
  int32_t layout = 0;
  aoti_torch_get_layout(values.get(), &layout);
  GS_CHECK(layout == aoti_torch_layout_strided() && values.dim() > 0, name, " must be dense and have rows");
  with_scalar(values.scalar_type(), [](auto) {});
}

#ifdef GS_CUDA
constexpr auto kHost = CUmemLocationType(2), kHostNuma = CUmemLocationType(3);  // the header has them from 12.2 on

// A function of the driver, which is not linked: this library also loads where there is none.
template <class Function>
void find(Function& function, const char* name) {
  void* found = nullptr;
  cudaDriverEntryPointQueryResult result{};
#if CUDART_VERSION >= 12050
  const cudaError_t status = cudaGetDriverEntryPointByVersion(name, &found, 12000, cudaEnableDefault, &result);
#else
  const cudaError_t status = cudaGetDriverEntryPoint(name, &found, cudaEnableDefault, &result);
#endif
  if (status != cudaSuccess) cudaGetLastError();  // so that nobody else meets the error
  GS_CHECK(status == cudaSuccess && found, "the GPU's driver has no ", name, ": update the driver");
  function = reinterpret_cast<Function>(found);
}

struct Driver {
  decltype(&cuMemGetAllocationGranularity) granularity;
  decltype(&cuMemAddressReserve) reserve;
  decltype(&cuMemCreate) create;
  decltype(&cuMemMap) map;
  decltype(&cuMemSetAccess) set_access;
  decltype(&cuMemRelease) release;
  decltype(&cuMemUnmap) unmap;
  decltype(&cuMemAddressFree) free;

  Driver() {
    find(granularity, "cuMemGetAllocationGranularity");
    find(reserve, "cuMemAddressReserve");
    find(create, "cuMemCreate");
    find(map, "cuMemMap");
    find(set_access, "cuMemSetAccess");
    find(release, "cuMemRelease");
    find(unmap, "cuMemUnmap");
    find(free, "cuMemAddressFree");
  }
};

const Driver& driver() {
  static const Driver functions;
  return functions;
}

void check_driver(CUresult result, const char* what) {
  GS_CHECK(result == CUDA_SUCCESS, what, " failed with the driver's error ", int(result));
}

size_t rounded_up(size_t bytes, size_t unit) { return (bytes + unit - 1) / unit * unit; }

// A range of addresses that the device reads and writes: `near` bytes of its own memory, then `far` of the host's.
class Range {
 public:
  Range(int device, size_t bytes, size_t near) : device_(device) {
    const size_t unit = std::max(granularity(CU_MEM_LOCATION_TYPE_DEVICE, device), granularity(kHost, 0));
    near_ = std::min(near / unit * unit, rounded_up(bytes, unit));
    far_ = rounded_up(std::max<size_t>(bytes, 1) - std::min(near_, bytes), unit);
    check_driver(driver().reserve(&place_, near_ + far_, 0, 0, 0), "cuMemAddressReserve");
    try {
      if (near_) map(CU_MEM_LOCATION_TYPE_DEVICE, device, near_);
      if (far_) map(kHost, 0, far_);
      CUmemAccessDesc access{};
      access.location.type = CU_MEM_LOCATION_TYPE_DEVICE, access.location.id = device;
      access.flags = CU_MEM_ACCESS_FLAGS_PROT_READWRITE;
      check_driver(driver().set_access(place_, mapped_, &access, 1), "cuMemSetAccess");
    } catch (...) {
      release();
      throw;
    }
  }

  // Frees all of it, once kernels that may still use it are done.
  void release() noexcept {
    int before = device_;
    cudaGetDevice(&before);
    if (before != device_) cudaSetDevice(device_);
    cudaDeviceSynchronize();
    if (before != device_) cudaSetDevice(before);  // which takes memory of a GPU that nothing has used yet
    if (mapped_) driver().unmap(place_, mapped_);
    driver().free(place_, near_ + far_);
  }

  void* place() const { return reinterpret_cast<void*>(place_); }
  size_t near_bytes() const { return near_; }
  size_t far_bytes() const { return far_; }
  bool has(const void* address) const { return size_t(address) - size_t(place_) < near_ + far_; }

 private:
  static CUmemAllocationProp kind_of(CUmemLocationType where, int id) {
    CUmemAllocationProp kind{};
    kind.type = CU_MEM_ALLOCATION_TYPE_PINNED;
    kind.location.type = where, kind.location.id = id;
    return kind;
  }

  // 2 MiB where the driver does not say.
  static size_t granularity(CUmemLocationType where, int id) {
    const CUmemAllocationProp kind = kind_of(where, id);
    size_t found = 0;
    const CUresult result = driver().granularity(&found, &kind, CU_MEM_ALLOC_GRANULARITY_MINIMUM);
    return std::max<size_t>(result == CUDA_SUCCESS ? found : 0, size_t(2) << 20);
  }

  // Puts memory behind what is mapped.
  void map(CUmemLocationType where, int id, size_t bytes) {
    CUmemGenericAllocationHandle memory{};
    CUmemAllocationProp kind = kind_of(where, id);
    CUresult result = driver().create(&memory, bytes, &kind, 0);
    if (where == kHost && result != CUDA_SUCCESS && result != CUDA_ERROR_OUT_OF_MEMORY) {
      kind = kind_of(kHostNuma, 0);
      result = driver().create(&memory, bytes, &kind, 0);
    }
    GS_CHECK(result != CUDA_ERROR_OUT_OF_MEMORY, "OutOfMemoryError: the ", where == kHost ? "host" : "GPU",
             " is out of memory: ", int64_t(bytes), " bytes were asked for");
    check_driver(result, "cuMemCreate");
    result = driver().map(place_ + mapped_, bytes, 0, memory, 0);
    driver().release(memory);  // freed once it is not mapped any more
    check_driver(result, "cuMemMap");
    mapped_ += bytes;
  }

  int device_;
  size_t near_ = 0, far_ = 0, mapped_ = 0;
  CUdeviceptr place_ = 0;
};

// The ranges of living tensors, by their addresses: the driver's word on one address does not hold for the next.
std::mutex& ranges_mutex() {
  static std::mutex mutex;
  return mutex;
}

std::map<const void*, Range>& ranges() {
  static auto* const living = new std::map<const void*, Range>;  // tensors may live longer than statics do
  return *living;
}

void release(void* place, void*) {
  const std::lock_guard lock(ranges_mutex());
  const auto found = ranges().find(place);
  found->second.release();
  ranges().erase(found);
}
#endif

// An uninitialised tensor of `rows` rows like those of `like`, of whose bytes the first `near` are in the memory of its
// GPU, rounded down to whole pages, and all others in the host's. Null on the CPU, where there is one memory.
MaybeTensor spilled_op(const Tensor& like, int64_t rows, int64_t near) {
  check_rows(like, "like");
  GS_CHECK_VALUE(rows >= 0 && rows <= std::numeric_limits<int32_t>::max() && near >= 0,
                 "rows must be from 0 to 2^31 - 1 and near at least 0, got ", rows, " and ", near);
#ifdef GS_CUDA
  if (like.is_cuda()) {
    GS_CHECK(torch_from_blob, "spilled tensors need torch 2.11 or newer: update torch");
    const torch::stable::accelerator::DeviceGuard guard(like.get_device_index());
    Shape sizes(like.sizes().begin(), like.sizes().end());
    sizes[0] = rows;
    size_t bytes = like.element_size();
    for (int64_t size : sizes) bytes *= size;
    const Range range(like.get_device_index(), bytes, near);
    {
      const std::lock_guard lock(ranges_mutex());
      ranges().emplace(range.place(), range);
    }
    int32_t dtype = 0;
    aoti_torch_get_dtype(like.get(), &dtype);
    const Shape strides = strides_of(sizes);
    AtenTensorHandle made = nullptr;
    TORCH_ERROR_CODE_CHECK(torch_from_blob(range.place(), sizes.size(), sizes.data(), strides.data(), 0, dtype,
                                           aoti_torch_device_type_cuda(), like.get_device_index(), &made,
                                           aoti_torch_layout_strided(), nullptr, 0, &release, nullptr));
    return Tensor(made);
  }
#endif
  return {};
}

// (2,) int64 on the CPU: the bytes that the range of a spilled tensor has in the GPU's memory and in the host's, or 0
// and 0; without a tensor those of all living ones.
Tensor spilled_bytes_op(const MaybeTensor& of) {
  if (of) check_rows(*of, "of");
  Tensor both = torch::stable::empty({2}, ScalarType::Long);
  int64_t* found = write<int64_t>(both);
  found[0] = found[1] = 0;
#ifdef GS_CUDA
  const std::lock_guard lock(ranges_mutex());
  for (const auto& [place, range] : ranges())
    if (!of || (of->is_cuda() && range.has(of->const_data_ptr())))
      found[0] += range.near_bytes(), found[1] += range.far_bytes();
#endif
  return both;
}

}  // namespace

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define("spilled(Tensor like, int rows, int near) -> Tensor?", TORCH_BOX(&spilled_op));
  m.define_for_all("spilled_bytes(Tensor? of=None) -> Tensor", TORCH_BOX(&spilled_bytes_op));
}

}  // namespace gs::ops
