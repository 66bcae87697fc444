// The op that lets the calling thread's ops run ahead of a GPU, or stops that.
#include <limits>

#include "tensors.h"

namespace gs::ops {

namespace {

thread_local std::optional<gs::Ahead> current;

// Whether a tensor is in page-locked memory.
bool page_locked(const Tensor& t) {
  using torch::stable::detail::from;
  StableIValue stack[] = {from(t), from(std::nullopt)};
  TORCH_ERROR_CODE_CHECK(torch_call_dispatcher("aten::is_pinned", "", stack, TORCH_ABI_VERSION));
  return torch::stable::detail::to<bool>(stack[0]);
}

// words: halted, then what the last step needed (gs::Room), then the number of steps that were done. reports: of
// gs::Ahead. room: gs::Room.
void run_ahead_op(const MaybeTensor& words, Sizes room, const MaybeTensor& reports) {
  current.reset();
  if (!words) return;
  GS_CHECK_VALUE(words->is_cuda(), "words must be on a GPU, got ", words->device());
  check_tensor(*words, "words", ScalarType::Long, words->device(), {6});
  GS_CHECK_VALUE(room.size() == 4, "room must be of instances, slots, rows and blocks, got ", room.size(), " numbers");
  const int64_t most = std::numeric_limits<int32_t>::max();
  GS_CHECK_VALUE(room[0] >= 0 && room[0] <= most && room[1] >= 0 && room[2] >= 0 && room[2] <= most && room[3] >= 0,
                 "room must be from 0 to 2^31 - 1, got ", room);
  const int64_t count = reports && reports->dim() == 2 ? reports->size(0) : 0;
  if (reports) check_tensor(*reports, "reports", ScalarType::Long, DeviceType::CPU, {count, 6});
  GS_CHECK_VALUE(!reports || (0 < count && count <= most), "reports need a row");
  GS_CHECK_VALUE(words->is_contiguous() && (!reports || (reports->is_contiguous() && page_locked(*reports))),
                 "words and reports must be contiguous, and the reports in page-locked memory");
  int64_t* first = write<int64_t>(*words);
  current = gs::Ahead{reinterpret_cast<int32_t*>(first),    reinterpret_cast<gs::Room*>(first + 1),       first + 5,
                      {room[0], room[1], room[2], room[3]}, reports ? write<int64_t>(*reports) : nullptr, int(count)};
}

}  // namespace

const gs::Ahead* ahead() { return current ? &*current : nullptr; }

GS_OPERATORS(diff_gaussian_rasterization, m) {
  m.define_for_all("run_ahead_(Tensor(a!)? words, int[] room, Tensor(b!)? reports) -> ()", TORCH_BOX(&run_ahead_op));
}

}  // namespace gs::ops
