// The scheduler of the emulation: fibers, warps and their meetings.
#include "emulation.h"

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <deque>
#include <memory>
#include <random>
#include <vector>

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/common_interface_defs.h>
#define GS_ASAN 1
#endif

namespace gs::emulation {
namespace {

constexpr size_t kStack = 256 << 10;

[[noreturn]] void fail(const char* message, const char* what) {
  std::fprintf(stderr, "CUDA emulation: %s (%s) in block %u, thread %u\n", message, what ? what : "-", blockIdx.x,
               threadIdx.x);
  std::abort();
}

// Where a fiber goes on.
struct Point {
  void* words[5];  // of __builtin_setjmp
};

#define GS_SWITCHES __attribute__((noinline, no_sanitize_address))

[[noreturn]] GS_SWITCHES void leap(Point& to) { __builtin_longjmp(to.words, 1); }

// Goes on at `to`, and returns when somebody leaps to `from`. swapcontext would change the signal mask each time, a
// call of the kernel, which took more than half of the time.
GS_SWITCHES void go_on(Point& from, Point& to) {
  if (__builtin_setjmp(from.words) == 0) leap(to);
}

// The same for a fiber that has not begun.
GS_SWITCHES void enter(Point& from, ucontext_t& here, ucontext_t& fiber) {
  if (__builtin_setjmp(from.words) == 0) swapcontext(&here, &fiber);
}

struct Thread {
  ucontext_t context;
  Point point;
  bool begun = false;
  std::unique_ptr<char[]> stack;
#ifdef GS_ASAN
  void* fake_stack = nullptr;
#endif
};

// Of a thread. The scheduler reads all of these again and again, so they lie together.
struct State {
  Meeting waits_for;
  bool runnable;
  int votes;  // the block's votes that the thread has taken part in
  const char* what;
};

struct Warp {
  uint64_t slots[2][32];  // two, since a lane may be one meeting ahead of the slowest reader
  int turn[32];           // each lane uses this one of the two next
  unsigned absent;        // a bit for each lane that has ended, or that the block lacks
};

struct Grid {
  std::deque<Thread> threads;  // fibers keep references to theirs
  std::vector<State> states;
  std::vector<Warp> warps;
  std::vector<char> shared;
  ucontext_t context;  // of the scheduler, which is left when a thread begins
  Point scheduler;
  const std::function<void()>* body = nullptr;
  unsigned current = 0, count = 0;
  bool votes[3];  // this vote, the one before, which is still being read, and the one after
#ifdef GS_ASAN
  void* fake_stack = nullptr;
  const void* scheduler_stack = nullptr;
  size_t scheduler_size = 0;
#endif
};
Grid grid_state;
std::mt19937 generator(1);  // of shuffled orders

void to_scheduler(Thread& self) {
#ifdef GS_ASAN
  __sanitizer_start_switch_fiber(&self.fake_stack, grid_state.scheduler_stack, grid_state.scheduler_size);
#endif
  go_on(self.point, grid_state.scheduler);
#ifdef GS_ASAN
  __sanitizer_finish_switch_fiber(self.fake_stack, &grid_state.scheduler_stack, &grid_state.scheduler_size);
#endif
}

// A fiber runs its thread of one block after the other: a new one would cost calls of the kernel.
void start() {
#ifdef GS_ASAN
  __sanitizer_finish_switch_fiber(nullptr, &grid_state.scheduler_stack, &grid_state.scheduler_size);
#endif
  for (;;) {
    (*grid_state.body)();
    const unsigned current = grid_state.current;
    grid_state.states[current].waits_for = Meeting::done;
    grid_state.warps[current / 32].absent |= 1u << current % 32;
    to_scheduler(grid_state.threads[current]);
  }
}

void give_turn(unsigned index) {
  Thread& thread = grid_state.threads[index];
  grid_state.current = index;
  threadIdx = dim3(index, 0, 0);
#ifdef GS_ASAN
  __sanitizer_start_switch_fiber(&grid_state.fake_stack, thread.stack.get(), kStack);
#endif
  if (thread.begun)
    go_on(grid_state.scheduler, thread.point);
  else
    thread.begun = true, enter(grid_state.scheduler, grid_state.context, thread.context);
#ifdef GS_ASAN
  __sanitizer_finish_switch_fiber(grid_state.fake_stack, nullptr, nullptr);
#endif
}

// Releases the threads whose meeting is complete. As on a GPU, nobody waits for threads that have ended.
bool release() {
  const unsigned count = grid_state.count;
  bool any = false, whole_block = true;
  for (unsigned i = 0; i < count; ++i) {
    const State& thread = grid_state.states[i];
    whole_block = whole_block && (thread.waits_for == Meeting::block || thread.waits_for == Meeting::done);
  }
  for (unsigned first = 0; first < count; first += 32) {
    const unsigned stop = std::min(first + 32, count);
    const char* what = nullptr;
    bool whole_warp = true;
    for (unsigned i = first; i < stop; ++i) {
      const State& thread = grid_state.states[i];
      if (thread.waits_for == Meeting::done) continue;
      if (thread.waits_for != Meeting::warp) whole_warp = false;
      if (thread.waits_for == Meeting::warp && what && what != thread.what && std::strcmp(what, thread.what))
        fail("lanes of a warp meet in different collectives", what);
      if (thread.waits_for == Meeting::warp) what = thread.what;
    }
    for (unsigned i = first; i < stop; ++i) {
      State& thread = grid_state.states[i];
      if (thread.waits_for == Meeting::done || !(whole_warp ? true : whole_block)) continue;
      thread.runnable = true;
      any = true;
    }
  }
  return any;
}

// Sets a thread to the first line of the kernel.
void begin(Thread& thread, State& state) {
  if (!thread.begun) {
    getcontext(&thread.context);
    thread.context.uc_stack.ss_sp = thread.stack.get();
    thread.context.uc_stack.ss_size = kStack;
    thread.context.uc_link = nullptr;
    makecontext(&thread.context, &start, 0);
  }
  state = {Meeting::none, true, 0, nullptr};
}

void run_block(const std::function<void()>& body) {
  grid_state.body = &body;
  const unsigned count = grid_state.count;
  for (unsigned i = 0; i < count; ++i) begin(grid_state.threads[i], grid_state.states[i]);
  std::fill(grid_state.votes, grid_state.votes + 3, false);
  for (Warp& warp : grid_state.warps) std::fill(warp.turn, warp.turn + 32, 0), warp.absent = 0;
  if (count % 32) grid_state.warps.back().absent = ~0u << count % 32;
  std::vector<unsigned> turns(count);
  for (unsigned i = 0; i < count; ++i) turns[i] = order == Order::backward ? count - 1 - i : i;
  for (;;) {
    if (order == Order::shuffled) std::shuffle(turns.begin(), turns.end(), generator);
    for (unsigned index : turns) {
      if (!grid_state.states[index].runnable) continue;
      grid_state.states[index].runnable = false;
      give_turn(index);
    }
    bool done = true;
    for (unsigned i = 0; i < count; ++i) done = done && grid_state.states[i].waits_for == Meeting::done;
    if (done) return;
    if (!release()) fail("threads wait for each other at different barriers", nullptr);
  }
}

}  // namespace

void run_grid(dim3 grid, dim3 block, size_t shared, const std::function<void()>& body) {
  if (grid.y != 1 || grid.z != 1 || block.y != 1 || block.z != 1) fail("only one dimension is emulated", nullptr);
  grid_state.count = block.x;
  while (grid_state.threads.size() < block.x) {
    grid_state.threads.emplace_back();
    grid_state.threads.back().stack.reset(new char[kStack]);
  }
  grid_state.states.resize(block.x);
  grid_state.warps.resize((block.x + 31) / 32);
  gridDim = grid;
  blockDim = block;
  for (unsigned b = 0; b < grid.x; ++b) {
    blockIdx = dim3(b, 0, 0);
    grid_state.shared.assign(shared, char(0x7f));  // shared memory starts as garbage
    run_block(body);
  }
}

void restart() { generator.seed(1); }

void* dynamic_shared() { return grid_state.shared.data(); }

void meet(Meeting meeting, const char* what) {
  State& self = grid_state.states[grid_state.current];
  self.waits_for = meeting;
  self.what = what;
  to_scheduler(grid_state.threads[grid_state.current]);
}

int lane() { return int(grid_state.current % 32); }

bool any_of_block(bool mine) {
  const int vote = grid_state.states[grid_state.current].votes++;
  grid_state.votes[vote % 3] |= mine;
  meet(Meeting::block, "__syncthreads_or");
  grid_state.votes[(vote + 2) % 3] = false;
  return grid_state.votes[vote % 3];
}

const uint64_t* exchange(uint64_t mine, const char* what, unsigned mask) {
  if (mask != 0xffffffffu) fail("only whole warps are emulated", what);
  Warp& warp = grid_state.warps[grid_state.current / 32];
  if (warp.absent) fail("a lane of the mask has ended, or the warp is not whole", what);
  uint64_t* slots = warp.slots[warp.turn[lane()]++ % 2];
  slots[lane()] = mine;
  meet(Meeting::warp, what);
  return slots;
}

}  // namespace gs::emulation
