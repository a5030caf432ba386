// Solves every frame of a problem file with Ceres and writes what came out.
//
//     ceres_peer PROBLEMS RESULTS VARIANT [INITIAL_DAMPING]
//
// VARIANT: templated | dynamic (as the paper uses it), grouped | reduced (at its best).
// INITIAL_DAMPING is μ of the first step; 1e-4 is Ceres' default.
// Per frame a row of float64: cost at the start, at the end, linear solves, stopped by a tolerance
// (1 or 0), processor seconds of Solve, of building the problem, of the linear solver, final pose.
#include <ceres/ceres.h>
#include <glog/logging.h>

#include <cstdio>
#include <fstream>
#include <string>
#include <vector>

#include "as_paper.h"
#include "at_best.h"
#include "clock.h"
#include "problem.h"

static std::vector<double> SolveFrame(const Problem& problem, const Frame& frame,
                                      const std::string& variant, double damping,
                                      const Eigen::MatrixXd& prior_rows) {
  const bool paper = variant == "templated" || variant == "dynamic";
  std::vector<double> theta(frame.start, frame.start + problem.pose);
  const double before = ProcessorSeconds();
  ceres::Problem built;
  if (paper) {
    BuildAsPaper(problem, frame, theta.data(), variant == "dynamic", &built);
  } else {
    auto* body = new WholeBody(problem, frame, prior_rows, variant == "reduced");
    built.AddResidualBlock(body, nullptr, theta.data());
  }
  ceres::Solver::Options options;
  options.linear_solver_type =
      paper ? ceres::SPARSE_NORMAL_CHOLESKY : ceres::DENSE_NORMAL_CHOLESKY;
  options.trust_region_strategy_type = ceres::LEVENBERG_MARQUARDT;
  options.function_tolerance = problem.function_tolerance;
  options.max_num_iterations = problem.max_iterations;
  options.initial_trust_region_radius = 1 / damping;
  options.num_threads = 1;
  options.logging_type = ceres::SILENT;
  ceres::Solver::Summary summary;
  const double built_at = ProcessorSeconds();
  ceres::Solve(options, &built, &summary);
  const double done = ProcessorSeconds();
  std::vector<double> row = {summary.initial_cost,
                             summary.final_cost,
                             static_cast<double>(summary.num_linear_solves),
                             summary.termination_type == ceres::CONVERGENCE ? 1.0 : 0.0,
                             done - built_at,
                             built_at - before,
                             summary.linear_solver_time_in_seconds};
  row.insert(row.end(), theta.begin(), theta.end());
  return row;
}

int main(int argc, char** argv) {
  google::InitGoogleLogging(argv[0]);
  if (argc == 2 && std::string(argv[1]) == "--version") {
    std::printf("%s\n", CERES_VERSION_STRING);
    return 0;
  }
  const std::string variant = argc > 3 ? argv[3] : "";
  if (variant != "templated" && variant != "dynamic" && variant != "grouped" &&
      variant != "reduced") {
    std::fprintf(stderr, "usage: ceres_peer PROBLEMS RESULTS "
                         "templated|dynamic|grouped|reduced [INITIAL_DAMPING]\n");
    return 2;
  }
  try {
    const Problem problem(argv[1]);
    const double damping = argc > 4 ? std::stod(argv[4]) : 1e-4;
    const Eigen::MatrixXd prior_rows = PriorRows(problem);
    SolveFrame(problem, problem.frame(0), variant, damping, prior_rows);  // warm up
    std::ofstream out(argv[2], std::ios::binary);
    for (int t = 0; t < problem.frames; ++t) {
      const auto row = SolveFrame(problem, problem.frame(t), variant, damping, prior_rows);
      out.write(reinterpret_cast<const char*>(row.data()), row.size() * sizeof(double));
    }
    out.flush();
    if (!out) throw std::runtime_error(std::string("cannot write ") + argv[2]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "ceres_peer: %s\n", error.what());
    return 1;
  }
  return 0;
}
