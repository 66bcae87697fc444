// The chain rule of a block's Gaussians.
#include "../math/chain.h"

#include "../backend.h"

namespace gs {

template <class T>
void chain_rows(int64_t count, const T* factors, T* logits, T* log_scales) {
  for (int64_t i = 0; i < count; ++i) chain_rule(factors + kChain * i, logits + i, log_scales + 3 * i);
}

template void chain_rows<float>(int64_t, const float*, float*, float*);
template void chain_rows<double>(int64_t, const double*, double*, double*);

}  // namespace gs
