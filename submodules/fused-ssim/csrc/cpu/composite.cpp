// Composites an image with alpha on a background.
#include "../math/composite.h"

#include "../backend.h"

namespace gs {

void composite(const Composite& args, const Executor& executor) {
  constexpr int64_t kGrain = 1 << 15;
  const uint8_t* alpha = args.picture + 3 * args.pixels;
  executor.run(args.pixels, kGrain, [&](int64_t begin, int64_t end) {
    for (int channel = 0; channel < 3; ++channel) {
      const uint8_t* color = args.picture + channel * args.pixels;
      float* out = args.out + channel * args.pixels;
      const float background = args.background[channel];
      for (int64_t i = begin; i < end; ++i) out[i] = composite(color[i], alpha[i], background);
    }
  });
}

}  // namespace gs
