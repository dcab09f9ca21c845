#include "controller_file.hpp"

#include <cmath>
#include <cstring>
#include <limits>
#include <stdexcept>
#include <string>

#include "kernels.hpp"

namespace difflcs {
namespace {

constexpr unsigned char kMagic[] = {0x89, 'L', 'C', 'S', '\r', '\n', 0x1a, '\n'};
constexpr size_t kHeader = 24, kName = 16;
// Larger sizes are refused: their products would not fit into 64 bits.
constexpr int64_t kLargestSize = 100000;
// A double holds every whole number up to it.
constexpr int64_t kLargestCount = int64_t{1} << 53;

[[noreturn]] void refuse(const std::string& what) { throw std::runtime_error(what + "; export the controller again"); }

uint64_t little_endian(const unsigned char* from, int bytes) {
  uint64_t value = 0;
  for (int i = bytes - 1; i >= 0; i--) value = value << 8 | from[i];
  return value;
}

uint32_t crc32(const unsigned char* from, size_t size) {
  uint32_t crc = 0xffffffff;
  for (size_t i = 0; i < size; i++) {
    crc ^= from[i];
    for (int bit = 0; bit < 8; bit++) crc = crc >> 1 ^ (crc & 1 ? 0xedb88320 : 0);
  }
  return ~crc;
}

class Reader {
 public:
  Reader(const void* bytes, size_t size) : at_(static_cast<const unsigned char*>(bytes)), left_(size) {
    if (size < kHeader || std::memcmp(at_, kMagic, sizeof kMagic) != 0)
      refuse("expected a controller file of difflcs, got " +
             (size < kHeader ? std::to_string(size) + " bytes" : std::string("another kind of file")));
    const uint64_t version = little_endian(at_ + 8, 4), whole = little_endian(at_ + 16, 8);
    if (version != kControllerVersion)
      refuse("expected version " + std::to_string(kControllerVersion) + " of the format, got " +
             std::to_string(version) + ", which another difflcs has written");
    if (whole != size)
      refuse("expected " + std::to_string(whole) + " bytes, got " + std::to_string(size) + ": the file was cut or grew");
    if (crc32(at_ + 16, size - 16) != little_endian(at_ + 12, 4))
      refuse("the checksum does not match: the file is damaged");
    at_ += kHeader;
    left_ -= kHeader;
  }

  // Reads the doubles of the next entry, which must have this name.
  Numbers take(const char* name) {
    char wanted[kName + 1] = {};
    std::strncpy(wanted, name, kName);
    if (left_ < kName + 8 || std::memcmp(at_, wanted, kName) != 0)
      refuse(std::string("expected the entry ") + name + ", got " + (left_ < kName + 8 ? "the end" : "another one"));
    const uint64_t count = little_endian(at_ + kName, 8);
    at_ += kName + 8;
    left_ -= kName + 8;
    if (count > left_ / 8) refuse(std::string(name) + ": expected its numbers, got the end of the file");
    Numbers numbers{int64_t(count)};
    for (uint64_t i = 0; i < count; i++) {
      const uint64_t bits = little_endian(at_ + 8 * i, 8);
      std::memcpy(numbers.get() + i, &bits, 8);
    }
    at_ += 8 * count;
    left_ -= 8 * count;
    return numbers;
  }

  Numbers take(const char* name, int64_t count, bool finite = true) {
    Numbers numbers = take(name);
    expect_count(name, numbers, count);
    for (int64_t i = 0; finite && i < count; i++)
      if (!std::isfinite(numbers.get()[i])) refuse(std::string(name) + ": expected finite numbers, got another");
    return numbers;
  }

  double number(const char* name, double least, double most = 1e300) {
    const double value = take(name, 1, false).get()[0];
    if (!(value >= least && value <= most))
      refuse(std::string(name) + ": expected a number from " + std::to_string(least) + " to " + std::to_string(most) +
             ", got " + std::to_string(value));
    return value;
  }

  int64_t size(const char* name, int64_t least, int64_t most = kLargestSize) {
    const double value = number(name, double(least), double(most));
    if (value != std::floor(value)) refuse(std::string(name) + ": expected a whole number");
    return int64_t(value);
  }

  void end() const {
    if (left_) refuse("expected the end of the file, got " + std::to_string(left_) + " more bytes");
  }

  static void expect_count(const char* name, const Numbers& numbers, int64_t count) {
    if (numbers.count() != count)
      refuse(std::string(name) + ": expected " + std::to_string(count) + " numbers, got " +
             std::to_string(numbers.count()));
  }

 private:
  const unsigned char* at_;
  size_t left_;
};

// Numbers that may be infinite, but not anything else.
void check_limits(const ControllerData& data) {
  for (const Input which : {ku_min, ku_max, kg, kprice}) {
    const double wrong = which == ku_max || which == kprice || which == kg ? -INFINITY : INFINITY;
    for (int64_t i = 0; i < data.field[which].count(); i++) {
      const double value = data.field[which].get()[i];
      if (std::isnan(value) || value == wrong || (which == kprice && !(value > 0)))
        refuse(std::string(kMpcFields[which].name) + ": expected limits that can be met, got " + std::to_string(value));
    }
  }
  for (int64_t i = 0; i < data.batch.horizon * data.batch.n_u; i++) {
    const Bound bound(data.batch, 0, i);
    if (!(bound.low <= bound.high)) refuse("u_min: expected at most u_max");
  }
}

}  // namespace

ControllerData read_controller(const void* bytes, size_t size) {
  Reader reader(bytes, size);
  ControllerData data{};
  MpcBatch& batch = data.batch;
  MpcEffort& effort = data.effort;
  batch.count = batch.version = 1;
  batch.n_x = reader.size("n_x", 1);
  batch.n_u = reader.size("n_u", 1);
  batch.n_lam = reader.size("n_lam", 0);
  batch.n_c = reader.size("n_c", 0);
  batch.horizon = reader.size("horizon", 1);
  data.n_goal = reader.size("n_goal", 0);
  constexpr double kSmallestNumber = std::numeric_limits<double>::min();
  batch.relaxation = reader.number("relaxation", kSmallestNumber);
  batch.barrier = reader.number("barrier", 0);
  effort.tol = reader.number("tol", kSmallestNumber);
  effort.certified = reader.number("certified", kSmallestNumber);
  effort.homotopy = reader.number("homotopy", 0);
  effort.shrink = reader.number("shrink", kSmallestNumber, 1 - 1e-12);
  effort.max_iter = reader.size("max_iter", 1, kLargestCount);
  effort.seed = uint64_t(reader.size("seed", 0, kLargestCount));
  effort.starts = reader.size("starts", 1);
  effort.groups = reader.size("groups", 1);
  effort.sure = reader.size("sure", 1);
  effort.seeks = reader.size("seeks", 0);
  data.starts_guessed = reader.size("starts_guessed", 1);
  data.step_seconds = reader.number("step_seconds", 0);
  for (int i = 0; i < kInputs; i++) {
    if (i == kx0) continue;
    const Field& field = kMpcFields[i];
    const bool may_be_infinite = i == ku_min || i == ku_max || i == kg || i == kprice;
    data.field[i] = reader.take(field.name);
    const int64_t once = extent(batch, field), stages = stages_of(batch, field);
    const bool by_stage = stages > 1 && once > 0 && data.field[i].count() == stages * once;
    if (!by_stage) Reader::expect_count(field.name, data.field[i], once);
    batch.input[i] = data.field[i].get();
    batch.step[i] = by_stage ? once : 0;
    for (int64_t j = 0; !may_be_infinite && j < data.field[i].count(); j++)
      if (!std::isfinite(data.field[i].get()[j]))
        refuse(std::string(field.name) + ": expected finite numbers, got another");
  }
  const int64_t map = batch.n_x * data.n_goal, square = data.n_goal * data.n_goal;
  data.goal_to_q = reader.take("goal_to_q", map);
  data.goal_to_q_final = reader.take("goal_to_q_final", map);
  data.goal_stage = reader.take("goal_stage", square);
  data.goal_final = reader.take("goal_final", square);
  data.constant = reader.number("constant", -1e300);
  reader.end();
  check_limits(data);
  return data;
}

}  // namespace difflcs
