// The CUDA kernels on the CPU (submodules/common/emulation), under the sanitizers, against the CPU backend: threads
// taken in several orders must give the same bits, and every result lies within rounding of the CPU's.
#include "backend_run.h"
#include "emulated_queue.h"

namespace {

void check_near(const std::vector<float>& got, const std::vector<float>& wanted, double tolerance) {
  CHECK(got.size() == wanted.size());
  double largest = 0, error = 0;
  for (size_t i = 0; i < got.size(); ++i) {
    largest = std::max(largest, std::abs(double(wanted[i])));
    error = std::max(error, std::abs(double(got[i]) - wanted[i]));
    if (!std::isfinite(got[i])) error = INFINITY;
  }
  CHECK_NEAR(error / (largest > 0 ? largest : 1), 0, tolerance);
}

Result<float> run_emulated(Parameters<float>& p, gs::Image image, bool antialiasing, bool records,
                           gs::emulation::Order order) {
  gs::emulation::order = order;
  gs::emulation::Memory memory;
  return run(memory.queue(), p, image, antialiasing, records);
}

void test_against_cpu() {
  using gs::emulation::Order;
  for (const gs::Image image : {gs::Image{1, 1}, gs::Image{16, 16}, gs::Image{70, 33}})
    for (int64_t count : {0, 1, 33, 300})
      for (bool antialiasing : {false, true}) {
        Parameters<float> p(count);
        if (count == 300)  // one over all tiles, which whole warps list
          for (int k = 0; k < 3; ++k) p.scales[3 * 17 + k] = 1;
        const Result<float> cpu = run(gs::serial_executor(), p, image, antialiasing);
        const Result<float> got = run_emulated(p, image, antialiasing, true, Order::forward);
        CHECK(got.radii == cpu.radii && got.tile_counts == cpu.tile_counts);
        // exp2 and the order of sums differ; a pixel's 300 blends add some 1e-7 each.
        check_near(got.color, cpu.color, 2e-5), check_near(got.transmittance, cpu.transmittance, 2e-5);
        check_near(got.depth, cpu.depth, 2e-5);
        check_near(got.gradient, cpu.gradient, 2e-5);
        for (const Order order : {Order::backward, Order::shuffled}) {
          const Result<float> again = run_emulated(p, image, antialiasing, order == Order::backward, order);
          CHECK(again.color == got.color && again.transmittance == got.transmittance && again.depth == got.depth);
          CHECK(again.gradient == got.gradient);
        }
      }
}

void test_sparse_adam() {
  constexpr int64_t rows = 300, row = 45;
  for (const int64_t columns : {int64_t(0), int64_t(9), row}) {
    bool visible[rows];
    std::vector<float> gradient(rows * row), start[3];
    for (int64_t r = 0; r < rows; ++r) visible[r] = r % 3 != 1;
    for (float& g : gradient) g = float(normal());
    for (std::vector<float>& part : start)
      for (int64_t i = 0; i < rows * row; ++i) part.push_back(float(std::abs(normal())));
    const auto step = [&](const auto& where, std::vector<float>(&state)[3]) {
      using gs::GS_ISA::sparse_adam, gs::cuda::sparse_adam;
      gs::AdamInput<float> in{};
      in.value = state[0].data(), in.gradient = gradient.data();
      in.mean = state[1].data(), in.square = state[2].data();
      in.rows = rows, in.row = row, in.columns = columns;
      in.lr = 0.01, in.beta1 = 0.9, in.beta2 = 0.999, in.eps = 1e-15;
      sparse_adam(where, in, visible);
    };
    std::vector<float> cpu[3] = {start[0], start[1], start[2]}, got[3] = {start[0], start[1], start[2]};
    step(gs::serial_executor(), cpu);
    gs::emulation::Memory memory;
    step(memory.queue(), got);
    for (int part = 0; part < 3; ++part) {
      check_near(got[part], cpu[part], 1e-6);  // some units in the last place
      for (int64_t i = 0; i < rows * row; ++i)
        CHECK((got[part][i] != start[part][i]) == (visible[i / row] && i % row < columns));
    }
  }
}

}  // namespace

int main() {
  test_against_cpu();
  test_sparse_adam();
  return gs::finish_tests("CUDA kernels, emulated");
}
