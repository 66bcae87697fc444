#pragma once
// Runs CUDA kernels on the CPU, a fiber per thread, so that they can be tested without a GPU. The address sanitizer
// finds accesses outside global memory and misaligned vectors. Threads run in any order, so that a missing barrier
// changes results. Collectives are checked: all lanes must meet in the same one. Blocks run one after the other; shared
// memory is static. Tests learn nothing about speed, about the rounding of PTX instructions, or about races between
// blocks.
//
// translate.py rewrites the few parts of a .cu file that are not C++.
#include <ucontext.h>

#include <cstdint>
#include <cstring>
#include <functional>

struct dim3 {
  unsigned x = 1, y = 1, z = 1;
  constexpr dim3(unsigned x_ = 1, unsigned y_ = 1, unsigned z_ = 1) : x(x_), y(y_), z(z_) {}
};
inline dim3 threadIdx, blockIdx, blockDim, gridDim;

namespace gs::emulation {

enum class Order { forward, backward, shuffled };
// The order in which the runnable threads of a block get their turns.
inline Order order = Order::forward;

// Runs body once per thread of each block.
void run_grid(dim3 grid, dim3 block, size_t dynamic_shared, const std::function<void()>& body);
void* dynamic_shared();

// The meeting that a thread waits for. Lanes of a warp that wait for different ones at once are a bug of the kernel.
enum class Meeting { none, warp, block, done };
// Ends the thread's turn until all of its warp or block have reached the same meeting. `what` names the collective.
void meet(Meeting meeting, const char* what);

// Leaves 8 bytes for the other lanes of the warp, meets them, and returns all 32 lanes' bytes. They stay valid until
// the next meeting but one.
const uint64_t* exchange(uint64_t mine, const char* what, unsigned mask);
int lane();
// Makes shuffled orders begin anew.
void restart();

// Tells whether `mine` is true in any thread of the block.
bool any_of_block(bool mine);

// The launch that translate.py writes for kernel<<<grid, block, shared, stream>>>(arguments...).
template <class Kernel>
auto launch(dim3 grid, dim3 block, size_t shared, void* /*stream*/, const Kernel& kernel) {
  return [=](auto... arguments) { run_grid(grid, block, shared, [&] { kernel(arguments...); }); };
}

template <class T>
T shuffle(T value, int from, const char* what, unsigned mask) {
  static_assert(sizeof(T) <= 8);
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  bits = exchange(bits, what, mask)[from >= 0 && from < 32 ? from : lane()];
  std::memcpy(&value, &bits, sizeof value);
  return value;
}

template <class T, class Combine>
T reduce(T value, const char* what, unsigned mask, const Combine& combine) {
  uint64_t bits = 0;
  std::memcpy(&bits, &value, sizeof value);
  const uint64_t* all = exchange(bits, what, mask);
  std::memcpy(&value, &all[0], sizeof value);
  for (int k = 1; k < 32; ++k) {  // including lanes that have ended since
    T other;
    std::memcpy(&other, &all[k], sizeof other);
    value = combine(value, other);
  }
  return value;
}

}  // namespace gs::emulation
