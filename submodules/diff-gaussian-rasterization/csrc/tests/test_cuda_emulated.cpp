// The CUDA kernels on the CPU (submodules/common/emulation), under the sanitizers, against the CPU backend. Several
// orders of the threads must give the same bits, and every result must lie within rounding of the CPU's.
#include <algorithm>
#include <cstring>

#include "backend_run.h"
#include "channels_run.h"
#include "cuda/bin/make_records.cuh"
#include "cuda/bin/sorted_lists.cuh"
#include "cuda/blend/front_first.cuh"
#include "emulated_queue.h"
#include "exchange_run.h"
#include "gs/check_shared.h"
#include "gs/gpu_forms.h"
#include "long_lists.h"
#include "math/camera_gradient.h"
#include "math/step_now.h"
#include "rows_run.h"
#include "step_run.h"

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
                           gs::emulation::Order order, bool absolute) {
  gs::emulation::order = order;
  gs::emulation::Memory memory;
  return run(memory.queue(), p, image, antialiasing, records, nullptr, absolute);
}

void check_results(const Result<float>& got, const Result<float>& cpu) {
  CHECK(got.radii == cpu.radii && got.tile_counts == cpu.tile_counts && got.decisive == cpu.decisive);
  // exp2 and the order of sums differ; a pixel's 300 blends add some 1e-7 each.
  check_near(got.color, cpu.color, 2e-5), check_near(got.transmittance, cpu.transmittance, 2e-5);
  check_near(got.depth, cpu.depth, 2e-5);
  check_near(got.gradient, cpu.gradient, 2e-5), check_near(got.absolute, cpu.absolute, 2e-5);
}

// Checks results near the CPU's, and the same bits in every order, with records and with rectangles.
void check_scene(Parameters<float>& p, gs::Image image, bool antialiasing, bool absolute) {
  using gs::emulation::Order;
  const Result<float> got = run_emulated(p, image, antialiasing, true, Order::forward, absolute);
  check_results(got, run(gs::serial_executor(), p, image, antialiasing, false, nullptr, absolute));
  for (const Order order : {Order::backward, Order::shuffled}) {
    const Result<float> again = run_emulated(p, image, antialiasing, order == Order::backward, order, absolute);
    CHECK(again.color == got.color && again.transmittance == got.transmittance && again.depth == got.depth);
    CHECK(again.gradient == got.gradient && again.decisive == got.decisive && again.absolute == got.absolute);
  }
}

void test_against_cpu() {
  for (const gs::Image image : {gs::Image{1, 1}, gs::Image{16, 16}, gs::Image{70, 33}, gs::Image{330, 70}})
    for (int64_t count : {0, 1, 33, 300})
      for (bool antialiasing : {false, true}) {
        Parameters<float> p(count);
        if (count < 300 && (image.width == 330 || antialiasing != (count == 1))) continue;
        if (count == 300)  // one covers all tiles: a whole warp tests them
          for (int k = 0; k < 3; ++k) p.scales[3 * 17 + k] = 1;
        if (count == 33) p.distort_view();
        if (count > 1) p.dc[3 * 20] = NAN, p.rest[45 * 21] = INFINITY;  // culled for their colours alone
        check_scene(p, image, antialiasing, antialiasing);
      }
}

void test_lenses() {
  for (const gs::Chart chart : {gs::Chart::kPerspective, gs::Chart::kEquidistant, gs::Chart::kEquirectangular}) {
    Parameters<float> p(100);
    p.lens = distorted(chart, 30, 34, 17);
    check_scene(p, gs::Image{70, 33}, chart == gs::Chart::kPerspective, false);
    p.rays = chart != gs::Chart::kEquirectangular;
    if (p.rays) check_scene(p, gs::Image{70, 33}, chart == gs::Chart::kEquidistant, true);
  }
  Parameters<float> p(100);  // a full panorama: splats cross its border
  p.lens = fisheye(0.0f, 34.5f, 16.0f);
  p.lens.chart = gs::Chart::kEquirectangular, p.lens.limit = p.lens.field = p.lens.steep = INFINITY, p.lens.beyond = 0;
  p.lens.focal_x = float(70 / (2 * kPi)), p.lens.focal_y = float(33 / kPi);
  for (int64_t i = 0; i < p.count; ++i) p.means[3 * i + 2] *= i % 2 ? 1 : -1;
  check_scene(p, gs::Image{70, 33}, true, false);
  p.rays = true;
  check_scene(p, gs::Image{70, 33}, true, false);
}

// Gaussians on rays. Some lie around the camera, some at its side and some are large.
Parameters<float> on_rays(int64_t count) {
  Parameters<float> p(count);
  p.rays = true;
  for (int64_t i = 0; i < count; i += 4) {
    p.means[3 * i + 2] = 1 + float(std::abs(normal()));
    for (int k = 0; k < 3; ++k) p.scales[3 * i + k] += 2;
  }
  return p;
}

void test_rays() {
  for (const auto& [count, image] : {std::pair{1, gs::Image{16, 16}}, {33, {70, 33}}, {300, {330, 70}}})
    for (bool antialiasing : {false, true}) {
      Parameters<float> p = on_rays(count);
      if (count != 33 && antialiasing != (count == 1)) continue;
      if (count == 33) p.distort_view();
      check_scene(p, image, antialiasing, antialiasing);
    }
}

// Passes of all widths, of one channel to several passes.
void test_channels() {
  using gs::emulation::Order;
  for (const auto& [count, channels, image] : {std::tuple{0, 3, gs::Image{16, 16}},
                                               {1, 1, {1, 1}},
                                               {33, 5, {70, 33}},
                                               {100, 16, {70, 33}},
                                               {100, 37, {70, 33}},
                                               {400, 20, {48, 40}}}) {
    Parameters<float> p(count);
    if (count == 400)  // lists of two chunks
      for (float& opacity : p.opacities) opacity -= 4;
    for (const bool rays : {false, true}) {
      p.rays = rays;
      const bool absolute = channels < 32 && rays != (count == 33), stops = count == 100;
      const ChannelsRun cpu = run_channels(gs::serial_executor(), p, image, channels, absolute, stops);
      std::vector<ChannelsRun> found;
      for (const Order order : {Order::forward, Order::shuffled}) {
        gs::emulation::order = order;
        gs::emulation::Memory memory;
        found.push_back(run_channels(memory.queue(), p, image, channels, absolute, stops));
      }
      const ChannelsRun& got = found[0];
      CHECK(got == found[1] && got.last == cpu.last);
      check_near(got.color, cpu.color, 2e-5), check_near(got.transmittance, cpu.transmittance, 2e-5);
      check_near(got.moments, cpu.moments, 2e-5), check_near(got.values, cpu.values, 2e-5);
      check_near(got.lengths, cpu.lengths, 2e-5);
    }
  }
}

// More tiles than kFewTiles, so that fewer warps share one, and a list of two chunks. One order only, because it is
// slow.
void test_many_tiles(gs::Rays rays) {
  constexpr gs::Image image{1040, 1024};
  Parameters<float> p(700);
  p.rays = rays != gs::kNoRays;
  if (rays == gs::kLensRays) p.lens = fisheye(860.0f, 519.5f, 511.5f);
  for (float& scale : p.scales) scale -= 1;  // for speed
  for (int64_t i = 100; i < p.count; ++i) {
    p.means[3 * i] = p.means[3 * i + 1] = 0.1f, p.means[3 * i + 2] = 4 + 0.001f * float(i);
    p.opacities[i] = -4.8f;
  }
  check_results(run_emulated(p, image, false, true, gs::emulation::Order::shuffled, true),
                run(gs::serial_executor(), p, image, false, false, nullptr, true));
}

// Two tiles whose lists several blocks share. The splats are wide. Some pixels end in the middle of the list, at opaque
// splats, and the others stay open to its end.
constexpr gs::Image kTwoTiles{25, 16};
Parameters<float> two_long_lists(int64_t count) {
  Parameters<float> p(count);
  for (int64_t i = 0; i < count; ++i) {
    const float depth = 2 + 2 * float(i) / count;
    const bool closing = i % 100 == 50 && i < count / 2;
    for (int k = 0; k < 2; ++k) p.means[3 * i + k] *= 0.2f * depth;
    p.means[3 * i + 2] = depth;
    p.opacities[i] = closing ? 0.0f : -5.2f + 0.2f * float(normal());
    for (int k = 0; k < 3; ++k) p.scales[3 * i + k] = std::log((closing ? 0.1f : 0.6f) * depth);
    if (closing) p.means[3 * i] = -0.3f * depth;
  }
  return p;
}

// A host that runs ahead: with enough room, exactly or more, the bits are those of a host that waits. With less room in
// one of the lists, the step halts, says what it needs and leaves the gradients alone, and so does every later step.
void check_ahead(Parameters<float>& p, gs::Image image, bool absolute, bool records) {
  const Result<float> wanted = run_emulated(p, image, false, true, gs::emulation::Order::forward, absolute);
  constexpr int kReports = 4;
  int32_t halted = 0;
  int64_t done = 0, reports[6 * kReports], *report = nullptr;
  gs::Room needed{};
  const auto go = [&](gs::Room room) {
    gs::emulation::order = gs::emulation::Order::shuffled;
    gs::emulation::Memory memory;
    gs::Queue queue = memory.queue();
    queue.halted = &halted;
    const gs::Ahead ahead{&halted, &needed, &done, room, reports, kReports};
    report = reports + 6 * ((done + 1) % kReports);
    std::fill_n(report, 6, -1);
    return run(queue, p, image, false, records, &ahead, absolute);
  };
  constexpr int64_t plenty = 20000;
  go({plenty, plenty, plenty, 0});
  const gs::Room exact = needed;
  CHECK(exact.instances == wanted.instances && exact.slots >= exact.instances && exact.rows <= exact.instances);
  CHECK(exact.rows > 0);
  for (const int64_t more : {0, 1000}) {
    const Result<float> got = go({exact.instances + more, exact.slots + more, exact.rows + more, 0});
    CHECK(got.color == wanted.color && got.gradient == wanted.gradient && got.instances == wanted.instances);
    CHECK(got.absolute == wanted.absolute);
    CHECK(halted == 0 && report[0] == exact.instances && report[1] == exact.slots && report[2] == exact.rows);
    CHECK(report[4] == 0 && report[5] == done);
  }
  const std::vector<float> untouched(wanted.gradient.size(), -77.0f), no_lengths(wanted.absolute.size(), -77.0f);
  for (int64_t gs::Room::* const lacking : {&gs::Room::instances, &gs::Room::slots, &gs::Room::rows})
    for (const int64_t of : {int64_t(0), exact.*lacking - 1}) {
      gs::Room room = exact;
      room.*lacking = of;
      CHECK(go(room).gradient == untouched);
      CHECK(halted == done + 1 && report[4] == done + 1 && report[5] == done + 1);
      CHECK(report[0] == exact.instances && report[1] == exact.slots &&
            report[2] == (lacking == &gs::Room::rows ? exact.rows : 0));
      const Result<float> later = go({plenty, plenty, plenty, 0});
      CHECK(later.gradient == untouched && later.absolute == no_lengths);
      CHECK(halted == done + 1 && report[4] == done + 1 && report[5] == done + 1);
      halted = 0;
    }
}

void test_ahead() {
  Parameters<float> p(300);
  for (int k = 0; k < 3; ++k) p.scales[3 * 17 + k] = 1;
  check_ahead(p, gs::Image{70, 33}, false, false);
  p = two_long_lists(900);
  check_ahead(p, kTwoTiles, true, true);
}

// Checks that several orders give the same bits, and these bits against the CPU. Every output may be left out.
void check_lists(const LongLists& lists) {
  const Blending cpu = blend_lists(gs::serial_executor(), lists, true, true, false);
  const auto emulated = [&](gs::emulation::Order order, bool depth, bool last, bool layers) {
    gs::emulation::order = order;
    gs::emulation::Memory memory;
    return blend_lists(memory.queue(), lists, depth, last, layers);
  };
  const Blending got = emulated(gs::emulation::Order::forward, true, true, true);
  const std::vector<float> Blending::* const planes[] = {&Blending::color, &Blending::transmittance, &Blending::depth};
  const size_t pixels = got.last.size();
  double error = 0;
  size_t alike = 0;
  for (size_t pixel = 0; pixel < pixels; ++pixel) {
    if (got.last[pixel] != cpu.last[pixel]) continue;  // rounding decides its end
    ++alike;
    for (const auto plane : planes)
      for (size_t i = pixel; i < (got.*plane).size(); i += pixels)
        error = std::max<double>(error, std::abs((got.*plane)[i] - (cpu.*plane)[i]));
  }
  CHECK(double(alike) > 0.99 * double(pixels));
  CHECK_NEAR(error, 0, 4e-6);  // a pixel's 600 blends in float, on both sides
  check_near(got.moments, cpu.moments, 2e-5);
  check_near(emulated(gs::emulation::Order::forward, true, true, false).moments, cpu.moments, 2e-5);
  const Blending shallow = blend_lists(gs::serial_executor(), lists, false, true, false);
  for (const bool layers : {false, true})
    check_near(emulated(gs::emulation::Order::shuffled, false, true, layers).absolute, shallow.absolute, 2e-5);
  for (const gs::emulation::Order order : gs::emulation::kOrders) {
    const Blending again = emulated(order, true, true, true);
    CHECK(again.color == got.color && again.transmittance == got.transmittance && again.depth == got.depth);
    CHECK(again.last == got.last && again.moments == got.moments);
    if (order != gs::emulation::Order::shuffled) continue;
    for (const auto& [depth, last] : {std::pair{false, true}, std::pair{true, false}, std::pair{false, false}}) {
      const Blending fewer = emulated(order, depth, last, true);
      CHECK(fewer.color == got.color && fewer.transmittance == got.transmittance);
      CHECK((!depth || fewer.depth == got.depth) && (!last || fewer.last == got.last));
    }
  }
}

// A list of twelve chunks. Up to 240 pixels end, one every eleven splats, so that some end in each chunk; the others
// stay open. An end takes up to three opaque splats at the pixel alone.
void add_ending_list(LongLists& lists, int faint, int ending) {
  for (int i = 0; i < faint; ++i) {
    lists.add_faint(-7.6f);
    const int pixel = i / 8 * 37 % 256;
    for (int k = 0; k < 3 && i % 8 == 0 && i / 8 < ending; ++k) lists.add(float(pixel % 16), float(pixel / 16), 4, 0);
  }
  lists.end_tile();
}

void test_pixels_that_end_in_every_chunk() {
  LongLists lists(gs::Image{16, 16});
  add_ending_list(lists, 2100, 240);
  check_lists(lists);
}

// Lists of none, few and many splats: for one block, for one block in two chunks, for several blocks. All pixels of one
// long list end early, and the tiles are cut off by the image.
void test_lists_of_all_lengths() {
  LongLists lists(gs::Image{6 * 16 + 7, 11});
  lists.end_tile();
  for (const int faint : {1, 250, 460}) add_ending_list(lists, faint, 6);
  for (int k = 0; k < 5; ++k) lists.add(8, 8, 0.001f, -0.1f);
  add_ending_list(lists, 1100, 0);
  for (const int faint : {513, 700}) add_ending_list(lists, faint, 90);
  check_lists(lists);
}

// Whether blocks share a list depends on the other lists; the image must not.
void test_shared_lists_are_blended_as_whole_ones() {
  LongLists lists(gs::Image{32, 16});
  add_ending_list(lists, 500, 60);
  for (int k = 0; k < 5; ++k) lists.add(8, 8, 0.001f, -0.1f);  // all pixels of the second tile end
  LongLists more = lists;
  lists.end_tile();
  more.instances.resize(more.instances.size() + gs::cuda::kShares * 800, more.instances.back());
  more.end_tile();
  const int64_t share = int64_t(more.instances.size()) / gs::cuda::kShares;
  CHECK(lists.ranges[1] > gs::cuda::kAlwaysWhole && lists.ranges[1] < share);
  gs::emulation::order = gs::emulation::Order::forward;
  gs::emulation::Memory memory;
  const Blending shared = blend_lists(memory.queue(), lists, true, true, true);
  const Blending whole = blend_lists(memory.queue(), more, true, true, true);
  CHECK(shared.color == whole.color && shared.transmittance == whole.transmittance && shared.depth == whole.depth);
  CHECK(shared.last == whole.last && shared.moments == whole.moments);
}

bool same_slots(const gs::SplatSlots& a, const gs::SplatSlots& b) {
  return a.first == b.first && a.skipped == b.skipped && a.wide == b.wide;
}

// Checks that binning alone gives the CPU's lists, of records or of rectangles, with slots and without.
void check_bins(Parameters<float>& p, gs::Image image) {
  const gs::Scene<float> scene = scene_of(p, image, false);
  const auto cpu = bin_scene(gs::serial_executor(), scene, {true, false, true});
  for (const gs::emulation::Order order : gs::emulation::kOrders)
    for (const bool slots : {false, true})
      for (const auto& [rects, records] : {std::pair{true, true}, std::pair{true, false}, std::pair{false, true}}) {
        if (records && !has_records(image)) continue;
        // 256 threads visit each of so many tiles, which takes long.
        if (!has_records(image) && (order != gs::emulation::Order::shuffled || !slots)) continue;
        if (!slots && order != gs::emulation::Order::shuffled) continue;
        gs::emulation::order = order;
        gs::emulation::Memory memory;
        const auto got = bin_scene(memory.queue(), scene, {rects, records, slots});
        CHECK(got->instances == cpu->instances && got->ranges == cpu->ranges);
        CHECK(got->slots.size() == (slots ? cpu->slots.size() : 0));
        CHECK(std::equal(got->slots.begin(), got->slots.end(), cpu->slots.begin(), same_slots));
        CHECK(got->slot_count == (slots ? cpu->slot_count : 0));
      }
}

// Splats over hundreds of tiles among small and culled ones: no splats, none with a tile.
void test_lists() {
  for (const gs::Image image : {gs::Image{330, 70}, gs::Image{264, 260}})
    for (const int64_t count : {0, 1, 150}) {
      if (count < 150 && image.width == 264) continue;
      Parameters<float> p(count);
      for (int64_t i = 20; i < count; i += 40)
        for (int k = 0; k < 3; ++k) p.scales[3 * i + k] = 0;
      for (int64_t i = 3; i < count; i += 7) p.means[3 * i + 2] = -1;
      check_bins(p, image);
    }
  Parameters<float> behind(40);
  for (int64_t i = 0; i < behind.count; ++i) behind.means[3 * i + 2] = -1;
  check_bins(behind, gs::Image{330, 70});
  Parameters<float> many(5000);  // lists of several pieces, and instances of equal depth
  for (int64_t i = 0; i < many.count; i += 2) many.means[3 * i + 2] = 4;
  check_bins(many, gs::Image{40, 20});
}

// An image of more tiles across than a record can count, with a splat at its right end.
void test_lists_without_records() {
  constexpr gs::Image wide{16 * 70000, 16};
  CHECK(has_records(gs::Image{16 * 65535, 16 * 65535}) && !has_records(gs::Image{1, 16 * 65535 + 1}));
  Parameters<float> p(60);
  for (float& scale : p.scales) scale -= 3;
  p.means[0] = 0.59f * 4, p.means[1] = 0, p.means[2] = 4;
  check_bins(p, wide);
}

// Where binning puts its lists.
gs::BinMemory lists_in(Rendered& to, int64_t count, gs::Image image, bool slots) {
  to.ranges.resize(tiles_of(image) + 1), to.slots.resize(slots ? count + 1 : 0);
  const auto take = [](void* context, int64_t instances, int64_t slot_count) {
    Rendered& r = *static_cast<Rendered*>(context);
    r.instances.resize(instances), r.slot_count = slot_count;
    return gs::Binned{r.instances.data(), r.ranges.data()};
  };
  return {take, &to, slots ? to.slots.data() : nullptr};
}

// Checks that sorting everything gives the CPU's lists, of splats that the CPU has projected.
void check_sorted(Parameters<float>& p, gs::Image image) {
  const gs::Scene<float> scene = scene_of(p, image, false);
  const auto cpu = bin_scene(gs::serial_executor(), scene, {true, false, true});
  for (const gs::emulation::Order order : gs::emulation::kOrders)
    for (const bool slots : {false, true}) {
      if (!slots && order != gs::emulation::Order::shuffled) continue;
      gs::emulation::order = order;
      gs::emulation::Memory memory;
      const gs::Queue queue = memory.queue();
      gs::Projected<float> in{cpu->splats.data(), cpu->depths.data(),
                              cpu->rects.data(),  cpu->tile_counts.data(),
                              cpu->radii.data(),  nullptr,
                              scene.rays(),       cpu->table.data()};
      gs::TileRecord* const made = in.records = gs::cuda::make_records(queue, p.count, in, image);
      const gs::cuda::Survey seen = gs::cuda::survey(queue, p.count, in);
      CHECK(seen.instances == int64_t(cpu->instances.size()) && seen.slots == cpu->slot_count);
      if (!seen.instances) {
        CHECK(!gs::cuda::sorting_pays(seen, p.count, tiles_of(image)));
        continue;
      }
      Rendered got;
      gs::cuda::sort_lists(queue, p.count, in, made, image, lists_in(got, p.count, image, slots), seen);
      CHECK(got.instances == cpu->instances && got.ranges == cpu->ranges);
      CHECK(std::equal(got.slots.begin(), got.slots.end(), cpu->slots.begin(), same_slots));
      CHECK(got.slot_count == (slots ? cpu->slot_count : 0));
    }
}

// Splats without a mask, some over all tiles, among small and culled ones and ones of equal depth: on rays or not, and
// on an image of more tiles than 16 bits count.
void test_sorted_lists() {
  for (const gs::Rays rays : {gs::kNoRays, gs::kPinholeRays, gs::kLensRays}) {
    Parameters<float> p(600);
    p.rays = rays != gs::kNoRays;
    if (rays == gs::kLensRays) p.lens = fisheye(275.0f, 164.5f, 34.5f);
    for (int64_t i = 0; i < p.count; ++i) {
      if (i % 2 == 0) p.means[3 * i] = p.means[3 * i + 1] = 0, p.means[3 * i + 2] = 4;
      if (i % 7 == 3) p.means[3 * i + 2] = -1;
      for (int k = 0; k < 3 && i % 20 == 1; ++k) p.scales[3 * i + k] = i % 40 == 1 ? 0 : -1.5f;
    }
    check_sorted(p, gs::Image{330, 70});
    if (rays == gs::kNoRays) check_sorted(p, gs::Image{40, 20});
  }
  Parameters<float> p(40);
  p.means[0] = 0, p.means[1] = 2.4f, p.means[2] = 4;  // over a thousand tiles, also the last ones
  for (int k = 0; k < 3; ++k) p.scales[k] = -1;
  check_sorted(p, gs::Image{4112, 4096});
  for (int64_t i = 0; i < p.count; ++i) p.means[3 * i + 2] = -1;
  check_sorted(p, gs::Image{330, 70});
}

// Takes iteration `number` on the CPU or the GPU from given gradients and radii.
template <class Where>
void take_step(const Where& where, Stepping& s, const StepCase& how, const std::vector<float>& gradients,
               const std::vector<int32_t>& radii, int64_t number) {
  Rendered r;
  r.radii = radii;
  step_plainly(where, s, how, r, number, [&](const gs::SceneGradient<float>& to) {
    std::copy(gradients.begin(), gradients.end(), to.means);  // all others lie behind
  });
  gs::ObserveInput lengths = s.observe(how, radii.data(), nullptr);
  lengths.lengths = gradients.data();
  using gs::observe;
  if (how.observed) observe(where, lengths);
}

std::vector<float> without_nan(std::vector<float> values) {
  std::replace_if(values.begin(), values.end(), [](float x) { return std::isnan(x); }, 77.0f);
  return values;
}

// Steps from gradients in memory and density statistics are the CPU's to rounding. Under a guard, a value that is not
// finite is marked and stops all later steps, as a loss does that is not finite.
void test_steps() {
  for (const int64_t count : {0, 130})
    for (const StepCase& how : kStepCases) {
      const Stepping start{Parameters<float>(count)};
      Stepping cpu = start, got = start;
      std::vector<int32_t> radii;
      for (int64_t i = 0; i < count; ++i) radii.push_back(i == 0 ? 3 : std::max(0, int(20 * normal())));
      for (int64_t iteration = 1; iteration <= 4; ++iteration) {
        std::vector<float> gradients;
        for (int64_t k = 0; k < 62 * count; ++k) gradients.push_back(float(normal()));
        if (iteration == 2 && count)
          for (size_t k = 0; k < gradients.size(); k += 501) gradients[k] *= how.gradient;
        if (iteration == 4) cpu.loss = got.loss = NAN;
        const Stepping before = got;
        gs::emulation::order = gs::emulation::kOrders[iteration % 3];
        gs::emulation::Memory memory;
        take_step(gs::serial_executor(), cpu, how, gradients, radii, iteration);
        take_step(memory.queue(), got, how, gradients, radii, iteration);
        for (int a = 0; a < gs::kStepped; ++a) {
          check_near(without_nan(*got.values.all()[a]), without_nan(*cpu.values.all()[a]), 1e-6);
          check_near(without_nan(got.mean[a]), without_nan(cpu.mean[a]), 1e-6);
          check_near(without_nan(got.square[a]), without_nan(cpu.square[a]), 1e-6);
        }
        CHECK(without_nan(got.statistics) == without_nan(cpu.statistics));
        if (!how.guarded || !count) continue;
        CHECK(got.stopped == cpu.stopped);
        const bool broken = std::isnan(how.gradient);
        CHECK(got.stopped == (broken && iteration > 1 ? 2 : iteration == 4 ? 4 : 0));
        CHECK((got.values.means == before.values.means) == (before.stopped || iteration == 4));
        if (broken && iteration == 2)
          CHECK(got.values.means[0] == before.values.means[0] && std::isnan(got.mean[0][0]));
      }
    }
}

// Noise and the children of split Gaussians have the CPU's bits. A halted queue leaves the means alone, and so does a
// guard that has stopped, of noise.
void test_displacements() {
  for (const int64_t n : {0, 1, 255, 700})
    for (const bool children : {false, true}) {
      std::vector<float> means, values;
      std::vector<int64_t> items;
      for (int64_t i = 0; i < 8 * n; ++i) values.push_back(float(2 * normal() - 3));
      for (int64_t i = 0; i < 3 * n; ++i) means.push_back(float(normal()));
      for (int64_t i = 0; i < n; ++i) items.push_back(i * 6700417);
      const auto input = [&](std::vector<float>& to, const int64_t* guard) {
        const float* v = values.data();
        gs::Displacement in{n, to.data(), v, v + 3 * n};
        in.seed = 1ull << 40, in.iteration = 600, in.stream = children ? 2 : 4;
        if (children) return in.items = items.data(), in.draw = 1, in;
        in.logits = v + 7 * n, in.size = 30, in.steepness = 100, in.threshold = 0.005;
        in.stopped = guard, in.first = 7'000;
        return in;
      };
      std::vector<float> wanted = means, got = means;
      gs::displace(gs::serial_executor(), input(wanted, nullptr));
      gs::emulation::Memory memory;
      gs::Queue queue = memory.queue();
      const int32_t halted = 1;
      const int64_t stopped[2] = {0, 5};
      queue.halted = &halted;
      gs::cuda::displace(queue, input(got, nullptr));
      queue.halted = nullptr;
      if (!children) gs::cuda::displace(queue, input(got, &stopped[1]));
      CHECK(got == means);
      gs::cuda::displace(queue, input(got, &stopped[0]));
      CHECK(got == wanted && (n < 255 || got != means));
    }
}

// Exponentials, logarithms and random words have the CPU's bits.
void test_elementary() {
  for (const int64_t n : {0, 1, 255, 700}) {
    std::vector<double> values;
    std::vector<int64_t> items;
    for (int64_t i = 0; i < n; ++i) values.push_back(std::abs(normal()) * 30), items.push_back(i * 6700417);
    gs::emulation::Memory memory;
    const gs::Queue queue = memory.queue();
    const gs::Executor cpu = gs::serial_executor();
    for (const bool logarithm : {false, true}) {
      std::vector<double> wanted(n), got(n);
      gs::elementary(cpu, gs::Elementary{n, values.data(), wanted.data(), logarithm});
      gs::cuda::elementary(queue, gs::Elementary{n, values.data(), got.data(), logarithm});
      CHECK(got == wanted);
    }
    std::vector<int64_t> wanted(4 * n), got(4 * n);
    gs::random_words(cpu, gs::RandomInput{n, items.data(), wanted.data(), 1ull << 40, 1, 600, 2});
    gs::cuda::random_words(queue, gs::RandomInput{n, items.data(), got.data(), 1ull << 40, 1, 600, 2});
    CHECK(got == wanted);
  }
}

// Checks something on a queue of its own, in every order of the threads.
template <class Check>
void in_every_order(const Check& check) {
  for (const gs::emulation::Order order : gs::emulation::kOrders) {
    gs::emulation::order = order;
    gs::emulation::Memory memory;
    check(memory.queue());
  }
}

void test_records() {
  for (const int bands : {1, 3, 40})
    for (const int64_t count : {0, 1, 255, 600})
      in_every_order([bands, count](const gs::Queue& queue) {
        const SomeRects rects(count, bands, count == 255 ? 14 : 10);
        for (const int64_t room : {int64_t(0), int64_t(3), bands * (count + 2)}) {
          const SomeRecords wanted = records(gs::serial_executor(), rects, room), got = records(queue, rects, room);
          CHECK(got == wanted);
          CHECK(count < 255 || room < count ||
                std::count(got.places.begin(), got.places.end(), -77) < room - count / 8);
          CHECK(room < bands * (count + 2) ||
                std::count(got.gaussians.begin(), got.gaussians.end(), count) == 3 * bands / 2);
        }
      });
}

// Sums of few rows have the CPU's bits but for its double precision; rows that are kept, all of them.
void test_runs() {
  for (const int values : {10, 12})
    for (const bool moved : {false, true})
      for (const std::vector<int32_t>& counts : counts_of_runs())
        in_every_order([values, moved, &counts](const gs::Queue& queue) {
          const SomeSums sums(counts, values, moved);
          const std::vector<float> wanted = sum(gs::serial_executor(), sums), got = sum(queue, sums);
          std::vector<size_t> runs(counts.size());
          for (size_t i = 0; i < runs.size(); ++i) runs[moved ? sums.places[i] : i] = i;
          size_t k = 0, next = 0;
          for (const size_t run : runs)
            for (next += size_t(values) * sums.kept[run]; k < next; ++k)
              CHECK(counts[run] == 1 || sums.kept[run] > 1 ? got[k] == wanted[k] : std::abs(got[k] - wanted[k]) < 1e-3);
          CHECK(std::count(got.end() - 2 * values, got.end(), -77.0f) == 2 * values);
        });
}

// What the CPU refuses stays within memory on a GPU.
void test_runs_that_do_not_fit() {
  gs::emulation::Memory memory;
  for (const auto& [run, count, kept] : {std::tuple{3, 1000, 1}, {3, -1000, 1}, {3, 2, -5}, {3, 2, 9}, {299, 2, 9}}) {
    SomeSums sums(std::vector<int32_t>(300, 2), 10);
    sums.counts[run] = count, sums.kept[run] = kept;
    CHECK(sum(memory.queue(), sums).size() == size_t(10 * sums.room));
  }
  for (const int32_t place : {-1, 5, 300}) {
    SomeSums sums(std::vector<int32_t>(300, 2), 10, true);
    sums.places[7] = place;
    CHECK(sum(memory.queue(), sums).size() == size_t(10 * sums.room));
  }
}

gs::SceneGradient<float> as_given(void* to) { return *static_cast<const gs::SceneGradient<float>*>(to); }

// Gradients of the emulated backward, into memory.
void emulated_gradients(const gs::Queue& queue, const Rendered& r, gs::SceneGradient<float> g,
                        float* lengths = nullptr) {
  gs::BlendGradient<float> backward = r.backward;
  backward.absolute = lengths;
  gs::cuda::rasterize_vjp(queue, r.scene, r.input, backward, {as_given, &g});
}

// Gradients of the emulated backward, from rows or from the lists.
std::vector<float> gradients_from(const gs::Queue& queue, const Rendered& r, const KeptRows* rows, float* lengths) {
  GradientsInMemory<float> gradient(r.scene.count);
  if (rows)
    gs::cuda::rows_vjp(queue, r.scene, rows->given(r), {r.splats.data(), r.scene.image, nullptr, lengths},
                       {as_given, &gradient.pointers});
  else
    emulated_gradients(queue, r, gradient.pointers, lengths);
  return gradient.memory;
}

// Rows give the bits of the lists, in every order of threads, also of splats with more rows than a lane adds.
void test_rows() {
  const auto check = [](Parameters<float> p, gs::Image image, gs::emulation::Order order, bool depth, bool layers) {
    gs::emulation::order = order;
    gs::emulation::Memory memory;
    const gs::Queue queue = memory.queue();
    check_rows(queue, scene_of(p, image, false), depth, layers,
               [&](const Rendered& r, const KeptRows* rows, float* lengths) {
                 return gradients_from(queue, r, rows, lengths);
               });
  };
  int at = 0;
  for (const Parameters<float>& p : scenes_for_rows())
    for (const bool depth : {false, true}) check(p, {40, 70}, gs::emulation::kOrders[at++ % 3], depth, !depth);
  check(scenes_for_rows()[3], {120, 70}, gs::emulation::Order::shuffled, true, true);
  check(on_rays(60), {70, 33}, gs::emulation::Order::shuffled, true, true);
  check(two_long_lists(900), {25, 40}, gs::emulation::Order::shuffled, true, false);
}

// Moves what changes from step to step to `now`.
void put_off(gs::GaussianStep<float>& step, gs::StepNow& now) {
  for (int a = 0; a < gs::kStepped; ++a) {
    gs::AdamInput<float>& in = step.attributes[a];
    gs::set_constants(now, a, gs::step_constants(step.sparse, in.lr, in.beta1, in.beta2, in.eps, in.step));
    in.lr = in.beta1 = in.beta2 = in.eps = in.step = NAN;
  }
  now.iteration = step.guard.iteration;
  step.guard.iteration = 77, step.now = &now;
}

// Steps taken inside the backward give the bits of steps from gradients in memory, in every order of threads, and with
// their constants in memory, or from rows. A halted queue changes nothing. The camera's gradient is that of before.
void test_gaussian_step() {
  for (const auto& [count, rays] : {std::pair{0, false}, {1, false}, {33, false}, {33, true}, {200, false}})
    for (const StepCase& how : kStepCases) {
      if (count != 33 && (&how - kStepCases) % 3 != count % 3) continue;  // each with some scene
      if (rays && !(how.guarded && how.sparse)) continue;
      const Stepping start{rays ? on_rays(count) : Parameters<float>(count)};
      Stepping plain = start, fused = start, stepped = start;
      for (int64_t iteration = 1; iteration <= 3; ++iteration) {
        gs::emulation::order = gs::emulation::kOrders[iteration % 3];
        const float gradient = iteration == 2 ? how.gradient : 1;
        gs::emulation::Memory memory;
        gs::Queue queue = memory.queue();
        const auto r = render_with(queue, scene_of(plain.values, {40, 24}, count == 33), gradient);
        step_plainly(queue, plain, how, *r, iteration,
                     [&](const gs::SceneGradient<float>& g) { emulated_gradients(queue, *r, g); });
        r->scene = scene_of(fused.values, r->scene.image, r->scene.antialiasing);  // has the values of before that step
        const int32_t halted[2] = {1, 0};
        std::array<double, kLensCameraNumbers> camera{}, apart{};
        const std::vector<uint8_t> unchanged = fused.bytes();
        for (const int32_t& word : halted) {
          queue.halted = &word;
          gs::GaussianStep<float> step = gaussian_step(fused, how, *r, iteration);
          gs::StepNow now;
          if (count == 33 || iteration == 3) put_off(step, now);
          step.camera = rays ? nullptr : camera.data();  // rays have no gradients of cameras
          gs::cuda::rasterize_vjp_step(queue, r->scene, r->input, r->backward, step);
          CHECK(word == 0 || (fused.bytes() == unchanged && camera == apart));
        }
        CHECK(fused.bytes() == plain.bytes());
        const KeptRows rows = keep_rows(queue, r->input, r->backward, false);
        const gs::Scene<float> before = scene_of(stepped.values, r->scene.image, r->scene.antialiasing);
        std::vector<double> blocks(kLensCameraNumbers * gs::sleep_blocks(count));
        if (!rays) gs::cuda::camera_vjp(queue, before, rows.given(*r), blocks.data());
        if (!rays) gs::cuda::sum_blocks(queue, gs::sleep_blocks(count), kPinholeNumbers, blocks.data(), apart.data());
        CHECK(std::memcmp(camera.data(), apart.data(), sizeof camera) == 0);
        gs::cuda::rows_vjp_step(queue, before, rows.given(*r), {}, gaussian_step(stepped, how, *r, iteration));
        CHECK(stepped.bytes() == plain.bytes());
      }
      CHECK(count < 200 || (fused.stopped == 2) == (how.guarded && std::isnan(how.gradient)));
      CHECK(count < 200 || fused.values.means != start.values.means);
    }
}

// Blocks wake on the GPU as on the CPU, where some lie behind the camera, one has missed nothing, and one is repeated.
// They are listed: none, or so many that the last one sleeps or is awake. Without room for them nothing changes. Where
// all wake for a step, they take part in it; where they rest, no step follows yet.
void test_wake(int64_t seen, gs::Chart chart = gs::Chart::kPinhole) {
  const bool some = seen > 0, last = seen == 4;
  for (const int64_t room : {5, 4, 3})
    for (const int wakes_all : {0, 1, 2})
      for (const gs::emulation::Order order : gs::emulation::kOrders) {
        const bool all = wakes_all, rests = wakes_all == 2;
        if (room != 5 && (all || order != gs::emulation::Order::shuffled)) continue;
        gs::emulation::order = order;
        constexpr int64_t count = 5 * gs::kSleepBlock - 28;
        Stepping start{Parameters<float>(count)};
        start.values.lens = distorted(chart, 30, 20, 12);
        for (int64_t i = 0; i < count; ++i) {
          const int64_t block = i / gs::kSleepBlock;
          start.values.means[3 * i + 2] = some && block % 2 == 0 && (block < 4 || last) ? 3.0f : -3.0f;
          for (int k = 0; k < 3; ++k) start.values.scales[3 * i + k] = -5;
        }
        float terms[2][gs::kTerms * gs::kTermColumns];
        for (int64_t k = 0; k < gs::kTerms * gs::kTermColumns; ++k) terms[0][k] = terms[1][k] = float(k % 7) * 1e-4f;
        Stepping got[2] = {start, start};
        uint8_t awake[2][5] = {{7, 7, 7, 7, 7}, {7, 7, 7, 7, 7}};
        const std::array<int32_t, 5> start_taken = {2, 1, 100, some ? 101 : 100, 9};
        std::array<int32_t, 5> taken[2] = {start_taken, start_taken};
        int32_t blocks[5], halted = 0;
        int64_t done = 6;
        gs::Room needed{1, 1, 1, 1};
        const gs::Ahead ahead{&halted, &needed, &done, {0, 0, 0, room}, nullptr, 1};
        for (const int on_gpu : {0, 1}) {
          gs::SleepInput<float> in{{},     all,  rests, awake[on_gpu], taken[on_gpu].data(), terms[on_gpu],
                                   blocks, room, &ahead};
          got[on_gpu].inputs({}, nullptr, in.step.attributes);
          for (gs::AdamInput<float>& to : in.step.attributes) to.step = 101;
          const gs::Scene<float> scene = scene_of(got[on_gpu].values, {40, 24}, false);
          gs::emulation::Memory memory;
          gs::Queue queue = memory.queue();
          queue.halted = &halted;
          if (on_gpu)
            gs::cuda::wake(queue, scene, in);
          else
            gs::GS_ISA::wake(gs::serial_executor(), scene, in);
        }
        CHECK(halted == (!all && room < seen ? 7 : 0) && (all || (needed.blocks == seen && needed.instances == 0)));
        if (halted) {
          CHECK(got[1].bytes() == start.bytes() && awake[1][1] == 7 && taken[1][0] == 2);
          continue;
        }
        const int32_t every[5] = {0, 2, 3, 4, -1};
        for (int64_t k = 0; k < room; ++k) CHECK(all || blocks[k] == (k < seen ? every[k] : -1));
        const uint8_t wakes[2][5] = {{some, 0, some, some, last}, {1, 1, 1, 1, 1}};
        for (int block = 0; block < 5; ++block) {
          CHECK(awake[0][block] == wakes[all][block] && awake[1][block] == wakes[all][block]);
          CHECK(taken[0][block] == taken[1][block] &&
                taken[0][block] == (wakes[all][block] ? 101 - rests : start_taken[block]));
        }
        for (int a = 0; a < gs::kStepped; ++a) {
          check_near(*got[1].values.all()[a], *got[0].values.all()[a], 1e-6);
          check_near(got[1].mean[a], got[0].mean[a], 1e-6), check_near(got[1].square[a], got[0].square[a], 1e-6);
          CHECK((*got[1].values.all()[a] != *start.values.all()[a]) == (some || all));
        }
        CHECK(std::equal(std::begin(terms[0]), std::end(terms[0]), std::begin(terms[1])));
      }
}

// Blocks that are listed take the step, with the bits of blocks that have flags.
void test_listed_blocks() {
  constexpr int64_t count = 5 * gs::kSleepBlock - 28, most = 4;
  const uint8_t awake[5] = {1, 0, 1, 0, 1};
  for (const gs::emulation::Order order : {gs::emulation::Order::forward, gs::emulation::Order::shuffled}) {
    gs::emulation::order = order;
    Stepping flagged{Parameters<float>(count)};
    std::fill(flagged.statistics.begin(), flagged.statistics.end(), 0.0f);
    Stepping listed = flagged, start = flagged;
    const auto step = [&](Stepping& s, const int32_t* blocks) {
      gs::emulation::Memory memory;
      const gs::Queue queue = memory.queue();
      gs::Scene<float> scene = scene_of(s.values, {40, 24}, false);
      blocks ? (scene.blocks = blocks, scene.listed = most) : (scene.awake = awake, 0);
      const auto r = render_with(queue, scene, 1);
      gs::GaussianStep<float> in = gaussian_step(s, {}, *r, 1);
      in.observed.blocks = blocks;
      std::vector<double> camera(kLensCameraNumbers);
      in.camera = camera.data();
      gs::cuda::rasterize_vjp_step(queue, r->scene, r->input, r->backward, in);
      std::vector<float> lengths(r->radii.size(), 0.5f);
      in.observed.count = int64_t(lengths.size()), in.observed.lengths = lengths.data();
      if (blocks) gs::cuda::observe(queue, in.observed);  // twice, to see where lengths go
      return std::make_tuple(r->color, camera, r->instances.size());
    };
    const int32_t blocks[most] = {0, 2, 4, -1};
    const auto image = step(flagged, nullptr);
    CHECK(step(listed, blocks) == image && std::get<2>(image) > 0);
    for (int64_t i = 0; i < count; ++i)
      CHECK(listed.statistics[2 * count + i] == 2 * flagged.statistics[2 * count + i]);
    listed.statistics = flagged.statistics;
    CHECK(listed.bytes() == flagged.bytes() && listed.bytes() != start.bytes());
  }
}

// Covariances and colours that are given, whose scene has no scales, rotations and coefficients to read.
void test_given_covariances_and_colors() {
  Parameters<float> p(50);
  std::vector<float> covariances, colors, got(50 * 9), wanted(50 * 9);
  for (int64_t i = 0; i < p.count; ++i) {
    p.opacities[i] = 0.5f;
    for (int k = 0; k < 3; ++k) colors.push_back(float(std::abs(normal())));
    for (const bool diagonal : {true, false, false, true, false, true})
      covariances.push_back(diagonal ? std::exp(2 * p.scales[i]) : 0);
  }
  gs::Scene<float> scene = scene_of(p, {40, 24}, false);
  scene.raw = scene.any_rotation = false;
  scene.scales = scene.rotations = scene.sh_dc = scene.sh_rest = nullptr, scene.rest_bands = 0;
  scene.cov3d = covariances.data(), scene.colors = colors.data();
  gs::SceneGradient<float> g{};
  gs::emulation::Memory memory;
  const auto r = render(memory.queue(), scene);
  g.cov3d = got.data(), g.colors = got.data() + 50 * 6;
  emulated_gradients(memory.queue(), *r, g);
  const auto cpu = render(gs::serial_executor(), scene);
  gs::GS_ISA::blend_vjp(gs::serial_executor(), cpu->input, cpu->backward);
  g.cov3d = wanted.data(), g.colors = wanted.data() + 50 * 6;
  gs::GS_ISA::project_vjp(gs::serial_executor(), scene, cpu->tile_counts.data(), cpu->moments.data(), g);
  check_near(got, wanted, 2e-5);
}

// Splats without tiles keep their shapes where that is asked for, on every device the same ones; lists stay as they
// are.
void test_kept_shapes() {
  using gs::baseline::kInverseDepth, gs::baseline::kLog2Opacity, gs::baseline::kSplatValues;
  for (const gs::Chart chart : {gs::Chart::kPinhole, gs::Chart::kPerspective}) {
    Parameters<float> p(500);
    if (chart != gs::Chart::kPinhole) p.lens = distorted(chart, 60, 34, 17);
    for (int64_t i = 0; i < p.count; ++i) p.opacities[i] = std::exp(-float(i % 7));
    for (float& scale : p.scales) scale = std::exp(scale);
    gs::Scene<float> scene = scene_of(p, {70, 33}, false);
    scene.raw = false;
    gs::emulation::Memory memory;
    const auto plain = bin_scene<float>(memory.queue(), scene, {});
    scene.keeps_shapes = true;
    const auto kept = bin_scene<float>(memory.queue(), scene, {});
    const auto cpu = bin_scene<float>(gs::serial_executor(), scene, {});
    CHECK(kept->instances == plain->instances && kept->tile_counts == plain->tile_counts);
    CHECK(kept->tile_counts == cpu->tile_counts);
    int64_t shapes = 0, culled = 0;
    for (int64_t i = 0; i < p.count; ++i) {
      const float *got = &kept->splats[kSplatValues * i], *wanted = &cpu->splats[kSplatValues * i];
      CHECK(std::isinf(got[kLog2Opacity]) == std::isinf(wanted[kLog2Opacity]));
      const bool shaped = !std::isinf(got[kLog2Opacity]);
      shapes += shaped && !kept->tile_counts[i], culled += !shaped;
      for (int k = 0; shaped && k <= kLog2Opacity; ++k)
        CHECK_NEAR(got[k], wanted[k], 1e-4 * (1 + std::abs(double(wanted[k]))));
      if (shaped) CHECK_NEAR(got[kInverseDepth], wanted[kInverseDepth], 1e-5);
    }
    CHECK(shapes > 20 && culled > 20);
  }
}

// The gradients of a camera's numbers, on an Executor or a Queue.
std::vector<double> camera_gradient(const gs::Executor& executor, const gs::Scene<float>& scene) {
  const int64_t blocks = gs::sleep_blocks(scene.count), numbers = gs::GS_ISA::camera_numbers(scene);
  std::vector<double> out(numbers), sums(numbers * blocks);
  const auto r = render(executor, scene);
  gs::GS_ISA::blend_vjp(executor, r->input, r->backward);
  gs::GS_ISA::camera_vjp(executor, scene, r->tile_counts.data(), r->moments.data(), sums.data());
  gs::GS_ISA::sum_blocks(blocks, numbers, sums.data(), out.data());
  return out;
}
std::vector<double> camera_gradient(const gs::Queue& queue, const gs::Scene<float>& scene) {
  const int64_t blocks = gs::sleep_blocks(scene.count), numbers = gs::GS_ISA::camera_numbers(scene);
  std::vector<double> out(numbers), sums(numbers * blocks);
  const auto r = render(queue, scene);
  const KeptRows rows = keep_rows(queue, r->input, r->backward, false);
  gs::cuda::camera_vjp(queue, scene, rows.given(*r), sums.data());
  gs::cuda::sum_blocks(queue, blocks, numbers, sums.data(), out.data());
  return out;
}

// Of a pinhole and of lenses, of Gaussians that fill no block, one, or several, and of none.
void test_cameras() {
  for (const gs::Chart chart : {gs::Chart::kPinhole, gs::Chart::kPerspective, gs::Chart::kEquidistant})
    for (const int64_t count : {0, 50, 300}) {
      const bool pinhole = chart == gs::Chart::kPinhole;
      Parameters<float> p(count);
      if (!pinhole) p.lens = distorted(chart, 60, 34, 17);
      const gs::Scene<float> scene = scene_of(p, gs::Image{70, 33}, count == 50);
      const std::vector<double> wanted = camera_gradient(gs::serial_executor(), scene);
      std::vector<double> first;
      for (const gs::emulation::Order order : gs::emulation::kOrders) {
        gs::emulation::order = order;
        gs::emulation::Memory memory;
        const std::vector<double> got = camera_gradient(memory.queue(), scene);
        if (first.empty()) first = got;
        CHECK(got == first && got.size() == size_t(pinhole ? kPinholeNumbers : kLensCameraNumbers));
        // Some 1e-5 of the largest Gaussian's part, of which others of the other sign leave a hundredth.
        for (size_t k = 0; k < got.size(); ++k) CHECK_NEAR(got[k], wanted[k], 1e-3 * std::abs(wanted[k]));
      }
    }
}

// The plain forms for older GPUs beside the others (gs/gpu_forms.h).
void test_plain_forms() {
  for (const auto order : gs::emulation::kOrders) {
    gs::emulation::order = order;
    std::vector<int> values(32);
    alignas(16) float from[32][4], shared[2][32][4] = {};
    for (int k = 0; k < 32; ++k) {
      values[k] = int(1e8 * normal());
      for (float& value : from[k]) value = float(normal());
    }
    unsigned all = 0;
    for (const int value : values) all |= unsigned(value);
    const auto [least, most] = std::minmax_element(values.begin(), values.end());
    const auto unsigned_least = unsigned(*least) ^ 1u << 31, unsigned_most = unsigned(*most) ^ 1u << 31;
    gs::emulation::run_grid(1, 32, 0, [&] {
      const int lane = gs::emulation::lane(), mine = values[lane];
      const unsigned shifted = unsigned(mine) ^ 1u << 31;  // in the same order
      CHECK(gs::warp_max(mine) == *most && gs::plain::warp_max(mine) == *most);
      CHECK(gs::warp_max(shifted) == unsigned_most && gs::plain::warp_max(shifted) == unsigned_most);
      CHECK(gs::warp_min(shifted) == unsigned_least && gs::plain::warp_min(shifted) == unsigned_least);
      CHECK(gs::warp_or(unsigned(mine)) == all && gs::plain::warp_or(unsigned(mine)) == all);
      const float4* row = reinterpret_cast<const float4*>(from[lane]);
      gs::start_copy(reinterpret_cast<float4*>(shared[0][lane]), row);
      gs::plain::start_copy(reinterpret_cast<float4*>(shared[1][lane]), row);
      __pipeline_commit();
      __pipeline_wait_prior(0);
      __syncwarp();
      for (const auto& rows : shared) CHECK(std::memcmp(rows[31 - lane], from[31 - lane], sizeof *from) == 0);
    });
  }
}

}  // namespace

void before() {
  generator.seed(4);
  gs::emulation::restart();
}

int main() {
  return gs::run_shared("CUDA kernels, emulated", before,
                        {test_lists_without_records,
                         test_rows,
                         test_gaussian_step,
                         [] { test_wake(4); },
                         [] { test_wake(3); },
                         [] { test_wake(3, gs::Chart::kPerspective); },
                         [] { test_wake(0); },
                         test_listed_blocks,
                         test_lists,
                         test_sorted_lists,
                         test_ahead,
                         test_pixels_that_end_in_every_chunk,
                         test_against_cpu,
                         test_lenses,
                         test_rays,
                         test_channels,
                         test_lists_of_all_lengths,
                         [] { test_many_tiles(gs::kNoRays); },
                         [] { test_many_tiles(gs::kPinholeRays); },
                         [] { test_many_tiles(gs::kLensRays); },
                         test_shared_lists_are_blended_as_whole_ones,
                         test_plain_forms,
                         test_records,
                         test_steps,
                         test_displacements,
                         test_elementary,
                         test_runs,
                         test_runs_that_do_not_fit,
                         test_given_covariances_and_colors,
                         test_kept_shapes,
                         test_cameras});
}
