// The forward of blending in images of few tiles. There, one long list would outlast all others together, so its chunks
// go to several blocks. A block blends its chunk as if nothing were in front. Only the transmittance in front says
// which pixels end in the chunk, and where: it is the product of what the chunks in front let through, so a block tells
// those behind it what its chunk lets through, and then waits for all in front. A warp with a pixel that ends in the
// chunk blends it once more. The last block of a list adds up what its chunks show.
//
// A block takes its number when it starts, and waits only for smaller ones, which wait for nothing before they have
// told what others need. So no order in which blocks start can stop them all. Nor does any result depend on the order:
// what a block knows at its start only saves it work.
#include <algorithm>
#include <cuda/atomic>

#include "blend_chunks.cuh"
#include "blend_layers.cuh"
#include "blend_layout.cuh"
#include "front_first.cuh"

namespace gs {
namespace cuda {

namespace {

using L = Layout<1>;  // a thread has a pixel
constexpr int kPixels = kTile * kTile;
static_assert(L::kThreads == kPixels && kLayerChunk == kPixels, "a chunk is one batch, a splat for each thread");

// Blocks of a launch, more than a GPU holds at once. Each takes one item after the other.
constexpr unsigned kMostBlocks = 1024;

constexpr float kOpaque = float(kMinTransmittance);

using Word = ::cuda::atomic_ref<int32_t, ::cuda::thread_scope_device>;

// What blocks tell each other. Each chunk has a place, also the first of a tile.
struct Progress {
  const Chunk* order;
  int32_t blocks;
  float* through;      // (places, kPixels) the share of the light that a chunk lets through, 0 where a pixel ends
  int32_t* published;  // (places) whether that is there
  int32_t* done;       // (tiles) finished chunks
  int32_t* taken;      // entries of `order` that have a block
};

// The transmittance behind a chunk, 0 where the pixel has ended.
__device__ float behind(float in_front, float through) {
  const float left = in_front * through;
  return left >= kOpaque ? left : 0;
}

// A chunk at a pixel, as if nothing were in front of the chunk.
struct Seen {
  float transmittance = 1, red = 0, green = 0, blue = 0, depth = 0;
  int last = 0;        // 1 + position in the chunk of the last splat blended
  bool ended = false;  // before the end of the chunk
};

// What a block works on, in shared memory: as registers they would be spilled.
struct Item {
  Chunk chunk;
  int64_t begin;   // of the list
  int32_t length;  // of the list
  int32_t number;  // what one warp tells the others

  __device__ bool whole() const { return chunk.first == 0 && chunk.end == length; }
  __device__ int64_t first_place() const { return begin / kLayerChunk + chunk.tile; }  // of the tile's chunks
};

// This thread's pixel in the block's tile.
struct Place {
  int left, top, in_tile;
  bool inside;
  int64_t pixel, plane;  // in the image

  __device__ Place(Image image, int tile) {
    const L at;
    const int across = tile_count(image.width);
    left = tile % across * kTile, top = tile / across * kTile, in_tile = at.y * kTile + at.x;
    inside = left + at.x < image.width && top + at.y < image.height;
    pixel = int64_t(top + at.y) * image.width + left + at.x, plane = int64_t(image.width) * image.height;
  }
};

// Blends the batch. front: the transmittance in front of it, or more; then no pixel ends too early.
template <bool kDepth, bool kLast, int kRays>
__device__ __forceinline__ Seen walk(const Batch<kPixels, kRays>& batch, const PlacesOf<L, kRays>& at, int count,
                                     float front) {
  Seen seen;
  float threshold = front > 0 ? kLeast : INFINITY;
  bool open = __any_sync(kWarp, front > 0);
  for (int from = 0; open && from < count; from += 32) {
    front_to_back(batch, at, from, count, [&](int k, const float (&t)[1]) {
      const bool reached = t[0] >= threshold;
      const float alpha = capped<float, float>(exp2_device(t[0]));
      const float after = seen.transmittance - alpha * seen.transmittance;
      const bool ends = reached && front * after < kOpaque, blended = reached && !ends;
      const float4 c = batch.color[k];
      if (blended) {
        const float weight = alpha * seen.transmittance;
        seen.red += weight * c.x, seen.green += weight * c.y, seen.blue += weight * c.z;
        if (kDepth) seen.depth += weight * batch.rest[k].w;
        if (kLast) seen.last = k + 1;
        seen.transmittance = after;
      }
      if (ends) threshold = INFINITY;
    });
    open = __any_sync(kWarp, threshold < 0);
  }
  seen.ended = front > 0 && threshold > 0;
  return seen;
}

// Counts the chunks of the list that have published without a gap: at least `known`, at most `wanted`. All threads of
// the block call this. wait: until all have.
__device__ int32_t count_published(const int32_t* published, int32_t known, int32_t wanted, bool wait,
                                   int32_t& of_block) {
  if (threadIdx.x < 32) {
    while (known < wanted) {
      const int32_t c = known + int32_t(threadIdx.x);
      const bool there = c >= wanted || Word(const_cast<int32_t&>(published[c])).load(::cuda::memory_order_acquire);
      const unsigned missing = ~__ballot_sync(kWarp, there);
      known += missing ? __ffs(missing) - 1 : 32;
      if (missing && !wait) break;
    }
    if (threadIdx.x == 0) of_block = known < wanted ? known : wanted;
  }
  __syncthreads();
  return of_block;
}

// Follows the light at this thread's pixel through the list's chunks from `from` to `to`.
__device__ float follow(const float* through, int32_t from, int32_t to, float front) {
  constexpr int kAhead = 8;  // loads that do not wait for each other
  for (int32_t c = from; c < to; c += kAhead) {
    float share[kAhead];
#pragma unroll
    for (int i = 0; i < kAhead; ++i)
      share[i] = c + i < to ? __ldcg(through + int64_t(kPixels) * (c + i) + threadIdx.x) : 1;
#pragma unroll
    for (int i = 0; i < kAhead; ++i) front = behind(front, share[i]);
  }
  return front;
}

template <int kRays, bool kDepth, bool kLast>
struct Blender {
  const BlendInput<float>& in;
  const Progress& progress;
  const Layers& layers;
  const Blended<float>& out;
  Batch<kPixels, kRays>& batch;
  Item& item;

  __device__ Place place() const { return {in.image, item.chunk.tile}; }

  // Blends a list, or a chunk of one.
  __device__ void blend() const {
    int32_t chunk = item.chunk.first / kLayerChunk, known = 0;  // known: chunks in front that `front` accounts for
    float front = place().inside ? 1 : 0;
    if (chunk > 0) {
      known = count_published(progress.published + item.first_place(), 0, chunk, false, item.number);
      front = follow(progress.through + kPixels * item.first_place(), 0, known, front);
    }
    Seen seen;
    bool open = item.length > 0 && __syncthreads_or(front > 0), fresh = true;
    if (!item.whole() && !open) publish(chunk, 0);
    while (open) {
      const int32_t left = item.chunk.end - chunk * kLayerChunk, count = left < kPixels ? left : kPixels;
      if (fresh) load(chunk, count);
      seen = walk<kDepth, kLast>(batch, PlacesOf<L, kRays>(in, item.chunk.tile), count, front);
      if (item.whole()) {
        const float next = seen.ended ? 0 : behind(front, seen.transmittance);
        open = left > kPixels && __syncthreads_or(next > 0);
        if (open) store(seen, front, chunk++), front = next;
      } else {
        open = fresh && resolve(seen, chunk, known, front);
        fresh = false;
      }
    }
    if (item.whole() && chunk == 0) return finish_single(seen);
    if (item.whole() || chunk > 0) store(seen, front, chunk);
    const int32_t chunks = item.whole() ? chunk + 1 : full_chunks(item.length, kLayerChunk) + 1;
    if (item.whole() || is_last(chunks)) add_up(chunks);
  }

  __device__ void load(int32_t chunk, int count) const {
    const Place at = place();
    const int32_t* instances = in.instances + item.begin + chunk * kLayerChunk;
    if (int(threadIdx.x) < count)
      batch.put(threadIdx.x, in, item.chunk.tile, instances[threadIdx.x], float(at.left), float(at.top));
    __syncthreads();
  }

  // Tells the blocks behind what the chunk lets through.
  __device__ void publish(int32_t chunk, float through) const {
    const int64_t place = item.first_place() + chunk;
    progress.through[kPixels * place + threadIdx.x] = through;
    __syncthreads();
    if (threadIdx.x == 0) Word(progress.published[place]).store(1, ::cuda::memory_order_release);
  }

  // Publishes what a chunk lets through, and finds the transmittance in front of it, of which the first `known` chunks
  // were known. Tells whether the warp must blend the chunk once more.
  __device__ bool resolve(const Seen& seen, int32_t chunk, int32_t known, float& front) const {
    if (chunk == 0) store(seen, front, 0);  // once this is published, others change it
    publish(chunk, front > 0 && !seen.ended ? seen.transmittance : 0);
    if (known == chunk) return false;
    count_published(progress.published + item.first_place(), known, chunk, true, item.number);
    const float exact = follow(progress.through + kPixels * item.first_place(), known, chunk, front);
    const bool ends = seen.ended || behind(exact, seen.transmittance) == 0;
    const bool once_more = exact > 0 && exact != front && ends;
    front = exact;
    return __any_sync(kWarp, once_more);
  }

  // Stores what a chunk of several shows. front: the transmittance in front of it.
  __device__ void store(const Seen& seen, float front, int32_t chunk) const {
    const Place at = place();
    if (chunk > 0) {
      const int64_t pixel = layer_pixel(item.begin, chunk) + at.in_tile;
      const bool lit = front > 0;  // what is not must not show, not even a product of 0 and infinity
      layers.color[pixel] =
          make_float4(lit ? front * seen.red : 0, lit ? front * seen.green : 0, lit ? front * seen.blue : 0, front);
      if (kDepth) layers.depth[pixel] = lit ? front * seen.depth : 0;
      if (kLast && front > 0 && seen.last) atomicMax(out.last + at.pixel, chunk * kLayerChunk + seen.last);
    } else if (at.inside) {
      put(at, seen.red, seen.green, seen.blue, seen.depth);
      if (kLast) out.last[at.pixel] = seen.last;
    }
    const bool to_end = (chunk + 1) * int64_t(kLayerChunk) >= item.length;
    if (front > 0 && (seen.ended || to_end)) out.transmittance[at.pixel] = front * seen.transmittance;
  }

  // Finishes a list of which only the first chunk is seen.
  __device__ void finish_single(const Seen& seen) const {
    const Place at = place();
    if (!at.inside) return;
    const float* background = in.background;
    put(at, seen.red + seen.transmittance * background[0], seen.green + seen.transmittance * background[1],
        seen.blue + seen.transmittance * background[2], seen.depth);
    out.transmittance[at.pixel] = seen.transmittance;
    if (kLast) out.last[at.pixel] = seen.last;
  }

  __device__ void put(const Place& at, float red, float green, float blue, float depth) const {
    out.color[at.pixel] = red, out.color[at.plane + at.pixel] = green, out.color[2 * at.plane + at.pixel] = blue;
    if (kDepth) out.inverse_depth[at.pixel] = depth;
  }

  // Counts the block's chunk as finished, and tells whether all of the list are.
  __device__ bool is_last(int32_t chunks) const {
    __syncthreads();
    if (threadIdx.x == 0)
      item.number = Word(progress.done[item.chunk.tile]).fetch_add(1, ::cuda::memory_order_acq_rel) + 1;
    __syncthreads();
    return item.number == chunks;
  }

  // Adds up what the list's first `chunks` chunks show, from back to front, and so completes their layers.
  __device__ void add_up(int32_t chunks) const {
    const Place at = place();
    if (!at.inside) return;
    constexpr int kAhead = 4;  // loads that do not wait for each other
    float4 sum = make_float4(0, 0, 0, 0);
    float depth = 0;
    for (int32_t c = chunks - 1; c > 0; c -= kAhead) {
      float4 color[kAhead];
      float of_depth[kAhead];
#pragma unroll
      for (int i = 0; i < kAhead; ++i) {
        const int64_t pixel = layer_pixel(item.begin, c - i > 0 ? c - i : 1) + at.in_tile;
        color[i] = __ldcg(layers.color + pixel);
        of_depth[i] = kDepth ? __ldcg(layers.depth + pixel) : 0;
      }
#pragma unroll
      for (int i = 0; i < kAhead; ++i) {
        if (c - i <= 0) break;
        const int64_t pixel = layer_pixel(item.begin, c - i) + at.in_tile;
        sum.x += color[i].x, sum.y += color[i].y, sum.z += color[i].z, sum.w = color[i].w;
        if (kLast) layers.color[pixel] = sum;
        depth += of_depth[i];
        if (kDepth && kLast) layers.depth[pixel] = depth;
      }
    }
    const float *first = out.color + at.pixel, *background = in.background;
    const float transmittance = __ldcg(out.transmittance + at.pixel);
    put(at, __ldcg(first) + sum.x + transmittance * background[0],
        __ldcg(first + at.plane) + sum.y + transmittance * background[1],
        __ldcg(first + 2 * at.plane) + sum.z + transmittance * background[2],
        kDepth ? __ldcg(out.inverse_depth + at.pixel) + depth : 0);
  }
};

// Bounding blocks per multiprocessor limits the kernel to 48 registers on sm_90.
template <int kRays, bool kDepth, bool kLast>
__global__ void __launch_bounds__(L::kThreads, blocks_at_once(kRays == kLensRays ? 4 : 5, L::kThreads))
    blend_chunks_kernel(const int32_t* halted, BlendInput<float> in, Progress progress, Layers layers,
                        Blended<float> out) {
  if (!begin_work(halted)) return;  // then nobody has set up `progress` either
  __shared__ Batch<kPixels, kRays> batch;
  __shared__ Item item;
  for (;;) {
    __syncthreads();
    if (threadIdx.x == 0) {
      const int32_t taken = atomicAdd(progress.taken, 1);
      item.chunk = taken < progress.blocks ? progress.order[taken] : Chunk{-1, 0, 0, 0};
      if (item.chunk.tile >= 0) {
        item.begin = in.ranges[item.chunk.tile];
        item.length = int32_t(in.ranges[item.chunk.tile + 1] - item.begin);
      }
    }
    __syncthreads();
    if (item.chunk.tile < 0) return;  // there are none behind
    Blender<kRays, kDepth, kLast>{in, progress, layers, out, batch, item}.blend();
  }
}

template <int kRays>
auto blend_chunks_kernel_for(bool depth, bool last) {
  return depth ? (last ? blend_chunks_kernel<kRays, true, true> : blend_chunks_kernel<kRays, true, false>)
               : (last ? blend_chunks_kernel<kRays, false, true> : blend_chunks_kernel<kRays, false, false>);
}

}  // namespace

void blend_chunks(const Queue& queue, const BlendInput<float>& in, const Blended<float>& out) {
  const int64_t tiles = tiles_of(in.image), places = in.instance_count / kLayerChunk + tiles;
  int32_t* numbers = queue.array<int32_t>(places + tiles + 1);
  const Schedule schedule = front_first(queue, tiles, in.ranges, in.instance_count, numbers, places + tiles + 1);
  float* through = queue.array<float>(places * kPixels);
  const Progress progress{schedule.chunks, int32_t(schedule.blocks), through,
                          numbers,         numbers + places,         numbers + places + tiles};
  const bool depth = out.inverse_depth;
  float* values = out.layers;
  if (!values) values = queue.array<float>(layer_values(in.image, in.instance_count, depth));
  const auto kernel = by_rays(in.rays, [&](auto rays) { return blend_chunks_kernel_for<rays>(depth, out.last); });
  const unsigned blocks = std::min(schedule.blocks, kMostBlocks);
  launch(queue, "blend_chunks", kernel, blocks, L::kThreads, in, progress, layers_at(values, in.instance_count), out);
}

}  // namespace cuda
}  // namespace gs
