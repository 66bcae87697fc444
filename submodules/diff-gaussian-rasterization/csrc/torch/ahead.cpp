// The op that lets the calling thread's ops run ahead of a GPU, or stops that.
#include "ahead.h"

#include <limits>

#include "tensors.h"

namespace gs::ops {

namespace {

thread_local std::optional<gs::Ahead> current;

// words: halted, then what the last step needed: gs::Room. report: of gs::Ahead. room: gs::Room.
void run_ahead_op(const MaybeTensor& words, at::IntArrayRef room, int64_t step, const MaybeTensor& report) {
  current.reset();
  if (!words) return;
  TORCH_CHECK_VALUE(words->is_cuda(), "words must be on a GPU, got ", words->device());
  check_tensor(*words, "words", at::kLong, words->device(), {4});
  TORCH_CHECK_VALUE(room.size() == 3, "room must be of instances, slots and rows, got ", room.size(), " numbers");
  const int64_t most = std::numeric_limits<int32_t>::max();
  TORCH_CHECK_VALUE(room[0] >= 0 && room[0] <= most && room[1] >= 0 && room[2] >= 0 && room[2] <= most,
                    "room must be from 0 to 2^31 - 1, got ", in_words(room));
  TORCH_CHECK_VALUE(0 < step && step <= most, "steps count from 1, got ", step);
  if (report) check_tensor(*report, "report", at::kLong, at::kCPU, {5});
  TORCH_CHECK_VALUE(words->is_contiguous() && (!report || (report->is_contiguous() && report->is_pinned())),
                    "words and report must be contiguous, and the report in page-locked memory");
  int64_t* first = words->mutable_data_ptr<int64_t>();
  current = gs::Ahead{reinterpret_cast<int32_t*>(first),
                      reinterpret_cast<gs::Room*>(first + 1),
                      {room[0], room[1], room[2]},
                      int32_t(step),
                      report ? report->mutable_data_ptr<int64_t>() : nullptr};
}

}  // namespace

const gs::Ahead* ahead() { return current ? &*current : nullptr; }

TORCH_LIBRARY_FRAGMENT(diff_gaussian_rasterization, m) {
  m.def("run_ahead_(Tensor(a!)? words, int[] room, int step, Tensor(b!)? report) -> ()", &run_ahead_op);
}

}  // namespace gs::ops
