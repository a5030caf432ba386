// Reads the file that benchmarks/peers/windows.py writes beside that of single poses: N consecutive
// instants as one problem, and the numbers of the three terms between instants
// (docs/cost_terms.md, "Between instants").
#pragma once

#include <string>

#include "problem.h"

constexpr double kGravity = 9.80665;
constexpr double kLossScale = 9.0;

class Windows : Numbers {
 public:
  Windows(const std::string& path, const Problem& problem)
      : Numbers(path, 20202.0), problem_(problem) {
    length = Integer();
    count = Integer();
    motion = *Take(1);
    increment = *Take(1);
    specific_force = *Take(1);
    steadiness = Take(1 + problem.bones);
    force_ = Take(3 * problem.imus * problem.frames);
    steps_ = Take(problem.frames - 1);
    rows_ = Take(static_cast<std::size_t>(1 + length * problem.pose) * count);
    if (Left() || length + count - 1 > problem.frames)
      throw std::runtime_error(path + " does not belong to these frames");
  }

  // Window w begins at frame w.
  double target(int w) const { return *Row(w); }
  const double* start(int w) const { return Row(w) + 1; }
  // Measured at a frame, in the bone's frame; NaN is missing.
  const double* force(int frame, int imu) const {
    return force_ + 3 * (problem_.imus * frame + imu);
  }
  // Weights of x at frame - 1, frame, frame + 1 in its second derivative.
  void Difference(int frame, double* c) const {
    const double before = steps_[frame - 1], after = steps_[frame];
    c[0] = 2.0 / (before * (before + after));
    c[2] = 2.0 / (after * (before + after));
    c[1] = -c[0] - c[2];
  }

  int length, count;
  double motion, increment, specific_force;
  const double* steadiness;  // of the root's place, then of every joint

 private:
  const double* Row(int w) const { return rows_ + (1 + length * problem_.pose) * w; }

  const Problem& problem_;
  const double *force_, *steps_, *rows_;
};
