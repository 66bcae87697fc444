// Writes the losses of images that are alike on every platform, or compares them with another run's.
#include "backend.h"
#include "gs/check_results.h"

namespace {

template <class T>
void add_losses(gs::Results& results) {
  gs::SameNumbers numbers;
  const int64_t height = 75, width = 301;
  std::vector<T> img1(3 * height * width), img2(img1.size()), gradient(img1.size()), loss_gradient(img1.size());
  for (T& value : img1) value = T(numbers.uniform());
  for (T& value : img2) value = T(numbers.uniform());
  const gs::ImagePair<T> images = {img1.data(), img2.data(), false, 3, height, width};
  std::vector<double> losses(2);
  gs::GS_ISA::l1_ssim_cpu(gs::L1Ssim<T>{images, false, &losses[0], &losses[1], gradient.data()}, gs::serial_executor());
  gs::GS_ISA::l1_ssim_vjp_cpu(gs::L1SsimVjp<T>{images, gradient.data(), 0.8, -0.2, loss_gradient.data()},
                              gs::serial_executor());
  results.add("L1 and SSIM", std::vector<T>(losses.begin(), losses.end()));
  results.add("gradient of SSIM", gradient), results.add("gradient of the loss", loss_gradient);
}

}  // namespace

int main(int argc, char** argv) {
  gs::Results results(argc, argv);
  add_losses<float>(results), add_losses<double>(results);
  return results.finish("fused-ssim results");
}
