// Solves every window of a file with Ceres, as far as the cost it names, and writes what came out.
//
//     ceres_window_peer PROBLEMS WINDOWS RESULTS VARIANT LINEAR_SOLVER [INITIAL_DAMPING]
//
// VARIANT: paper (as the paper uses it), joints | limbs | poses (at its best, by parameter blocks).
// LINEAR_SOLVER: sparse | dense | schur (of poses: every third is eliminated first).
// INITIAL_DAMPING is μ of the first step; 1e-4 is Ceres' default.
// Per window a row of float64: cost at the start, at the end, linear solves, reached (1 or 0),
// processor seconds of Solve up to there, of all Solve, of building the problem, of the linear
// solver, final poses. Up to there: Ceres linearises once more before it says how far it is, which
// does not count.
#include <ceres/ceres.h>
#include <glog/logging.h>

#include <cstdio>
#include <fstream>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "clock.h"
#include "window_as_paper.h"
#include "window_at_best.h"

class UntilTarget : public ceres::IterationCallback {
 public:
  UntilTarget(double target, const Instants& instants) : target_(target), instants_(instants) {}

  ceres::CallbackReturnType operator()(const ceres::IterationSummary& summary) override {
    if (summary.cost > target_) return ceres::SOLVER_CONTINUE;
    reached_at = instants_.linearised_at;
    return ceres::SOLVER_TERMINATE_SUCCESSFULLY;
  }

  double reached_at = 0;

 private:
  const double target_;
  const Instants& instants_;
};

static ceres::LinearSolverType LinearSolver(const std::string& name) {
  if (name == "sparse") return ceres::SPARSE_NORMAL_CHOLESKY;
  if (name == "dense") return ceres::DENSE_NORMAL_CHOLESKY;
  if (name == "schur") return ceres::DENSE_SCHUR;
  throw std::runtime_error("no linear solver " + name);
}

static std::vector<double> SolveWindow(const Problem& problem, const Windows& windows, int first,
                                       const std::string& variant,
                                       const std::string& linear_solver, double damping,
                                       const Eigen::MatrixXd& prior_rows) {
  const int size = windows.length * problem.pose;
  std::vector<double> theta(windows.start(first), windows.start(first) + size);
  const bool paper = variant == "paper";
  const double before = ProcessorSeconds();
  const Partition partition(problem, variant);
  Instants instants(problem, theta.data(), paper ? 0 : windows.length);
  const WindowParts parts{problem, windows, partition, instants, prior_rows};
  ceres::Problem::Options with_bodies;
  with_bodies.evaluation_callback = &instants;
  ceres::Problem built(with_bodies);
  if (paper)
    BuildWindowAsPaper(problem, windows, first, theta.data(), &built);
  else
    BuildWindowAtBest(parts, first, theta.data(), &built);
  UntilTarget until(windows.target(first), instants);
  ceres::Solver::Options options;
  options.linear_solver_type = LinearSolver(linear_solver);
  if (linear_solver == "schur") {
    options.linear_solver_ordering = std::make_shared<ceres::ParameterBlockOrdering>();
    for (int t = 0; t < windows.length; ++t)
      options.linear_solver_ordering->AddElementToGroup(theta.data() + t * problem.pose, t % 3 > 0);
  }
  options.callbacks.push_back(&until);
  options.function_tolerance = options.gradient_tolerance = options.parameter_tolerance = 1e-15;
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
                             until.reached_at > 0 ? 1.0 : 0.0,
                             until.reached_at - built_at,
                             done - built_at,
                             built_at - before,
                             summary.linear_solver_time_in_seconds};
  row.insert(row.end(), theta.begin(), theta.end());
  return row;
}

int main(int argc, char** argv) {
  google::InitGoogleLogging(argv[0]);
  if (argc < 6) {
    std::fprintf(stderr, "usage: ceres_window_peer PROBLEMS WINDOWS RESULTS "
                         "paper|joints|limbs|poses LINEAR_SOLVER [INITIAL_DAMPING]\n");
    return 2;
  }
  try {
    const Problem problem(argv[1]);
    const Windows windows(argv[2], problem);
    const double damping = argc > 6 ? std::stod(argv[6]) : 1e-4;
    const Eigen::MatrixXd prior_rows = PriorRows(problem);
    const auto solve = [&](int w) {
      return SolveWindow(problem, windows, w, argv[4], argv[5], damping, prior_rows);
    };
    solve(0);  // warm up
    std::ofstream out(argv[3], std::ios::binary);
    for (int w = 0; w < windows.count; ++w) {
      const auto row = solve(w);
      out.write(reinterpret_cast<const char*>(row.data()), row.size() * sizeof(double));
    }
    out.flush();
    if (!out) throw std::runtime_error(std::string("cannot write ") + argv[3]);
  } catch (const std::exception& error) {
    std::fprintf(stderr, "ceres_window_peer: %s\n", error.what());
    return 1;
  }
  return 0;
}
