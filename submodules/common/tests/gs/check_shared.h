#pragma once
// Runs long tests in two processes, as machines that build have at least two cores.
#include <sys/mman.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <cstdlib>
#include <initializer_list>
#include <new>

#include "gs/check.h"

namespace gs {

// Runs all tests, each in one of two processes, whichever is free; returns the exit status. Give long ones first.
// before: makes random numbers begin anew, so that those of a test do not depend on who has run the others.
inline int run_shared(const char* name, void (*before)(), std::initializer_list<void (*)()> tests) {
  void* memory = mmap(nullptr, sizeof(std::atomic<size_t>), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  if (memory == MAP_FAILED) return 1;
  auto& next = *new (memory) std::atomic<size_t>(0);
  const pid_t other = fork();
  while (true) {
    const size_t k = next++;
    if (k >= tests.size()) break;
    before();
    tests.begin()[k]();
  }
  if (other == 0) std::exit(failures() ? 1 : 0);
  int status = 0;
  if (other > 0 && (waitpid(other, &status, 0) != other || status != 0)) ++failures();
  return finish_tests(name);
}

}  // namespace gs
