// The file of a controller: one MPC problem with its options, which difflcs/mpc/controller_file.py writes. All numbers
// are little-endian:
//   8 bytes  0x89 "LCS" CR LF 0x1a LF    a file that was sent as text no longer begins like this
//   uint32   version of the format
//   uint32   CRC-32 (ISO-HDLC, as in zlib and PNG) of everything behind it
//   uint64   size of the whole file [byte]
//   entries  16 bytes name, zero-padded; uint64 count; `count` doubles
// The entries are those of controller_file.cpp, in its order. It checks the range of each number.
#pragma once
#include <cstddef>
#include <cstdint>
#include <memory>
#include <new>

#include "search.hpp"

namespace difflcs {

constexpr uint32_t kControllerVersion = 3;

// Numbers at a boundary of 64 bytes, zero at first.
class Numbers {
 public:
  Numbers() = default;
  explicit Numbers(int64_t count)
      : count_(count), data_(static_cast<double*>(::operator new(bytes(count), std::align_val_t{64}))) {
    for (int64_t i = 0; i < count; i++) data_.get()[i] = 0.0;
  }
  double* get() const { return data_.get(); }
  int64_t count() const { return count_; }

 private:
  struct Free {
    void operator()(double* p) const { ::operator delete(p, std::align_val_t{64}); }
  };
  static size_t bytes(int64_t count) { return sizeof(double) * size_t(count > 0 ? count : 1); }
  int64_t count_ = 0;
  std::unique_ptr<double, Free> data_;
};

// One problem with its solver's options. Other names are those of GoalCost (difflcs/cost.py).
struct ControllerData {
  MpcBatch batch;                      // this problem alone, with the fields below
  MpcEffort effort;                    // without a guess
  int64_t starts_guessed;              // with one
  int64_t n_goal;                      // 0: the cost knows no goal
  double step_seconds;                 // time from one step to the next [s]; 0 if not known
  Numbers field[kInputs];              // all but x0
  Numbers goal_to_q, goal_to_q_final;  // (n_x, n_goal)
  Numbers goal_stage, goal_final;      // (n_goal, n_goal)
  double constant;                     // of the objective
};

// Reads the bytes of a file. Throws std::runtime_error that says what is wrong with them, and std::bad_alloc.
ControllerData read_controller(const void* bytes, size_t size);

}  // namespace difflcs
