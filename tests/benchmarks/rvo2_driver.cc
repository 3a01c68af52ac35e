// Times the reference library RVO2 (https://github.com/snape/RVO2) on the worlds of the simulator benchmark.
//
// A process that reads whitespace-separated numbers on stdin and answers on stdout. First the scene:
//
//   dt range max_neighbours horizon radius v_max worlds robots groups
//   x y   for every robot of every world: start positions; robot i is of group i / robots
//   x y   for every group of every world: goals
//
// Then any number of commands, until the end of input:
//
//   run episodes steps   every world from its start, at rest; every robot heads for its goal
//                        -> seconds spent in doStep, robot steps, mean neighbours a robot
//   once robots          followed by x y vx vy pref_x pref_y of every robot of one world
//                        -> vx vy of every robot after one step, one a line
//
// Built together with RVO2's own sources into one program; the README beside this file has the command.

#include <chrono>
#include <cmath>
#include <cstddef>
#include <iomanip>
#include <iostream>
#include <memory>
#include <string>
#include <vector>

#include "RVOSimulator.h"
#include "Vector2.h"

namespace {

using Points = std::vector<RVO::Vector2>;
using Simulator = std::unique_ptr<RVO::RVOSimulator>;

struct Settings {
  float dt, range, horizon, radius, v_max;
  std::size_t max_neighbours;
};

struct World {
  Simulator simulator;
  Points start, goals;
};

RVO::Vector2 read_vector() {
  float x = 0.0F, y = 0.0F;
  std::cin >> x >> y;
  return RVO::Vector2(x, y);
}

Points read_points(std::size_t count) {
  Points points;
  for (std::size_t i = 0; i < count; ++i) points.push_back(read_vector());
  return points;
}

Simulator make_simulator(const Settings &s, const Points &positions) {
  auto simulator = std::make_unique<RVO::RVOSimulator>(s.dt, s.range, s.max_neighbours, s.horizon, s.horizon, s.radius,
                                                       s.v_max);
  for (const RVO::Vector2 &position : positions) simulator->addAgent(position);
  return simulator;
}

void restart(World &world) {
  for (std::size_t i = 0; i < world.start.size(); ++i) {
    world.simulator->setAgentPosition(i, world.start[i]);
    world.simulator->setAgentVelocity(i, RVO::Vector2());
  }
}

// Straight to the goal at v_max, slower within the last metre.
void head_for_goals(World &world, std::size_t robots, float v_max) {
  for (std::size_t i = 0; i < world.start.size(); ++i) {
    RVO::Vector2 heading = world.goals[i / robots] - world.simulator->getAgentPosition(i);
    const float length = std::sqrt(heading * heading);
    if (length > 1.0F) heading /= length;
    world.simulator->setAgentPrefVelocity(i, v_max * heading);
  }
}

void run(std::vector<World> &worlds, std::size_t robots, float v_max) {
  std::size_t episodes = 0, steps = 0, robot_steps = 0, neighbours = 0;
  std::cin >> episodes >> steps;
  std::chrono::steady_clock::duration spent{};
  for (std::size_t episode = 0; episode < episodes; ++episode) {
    for (World &world : worlds) restart(world);
    for (std::size_t step = 0; step < steps; ++step) {
      for (World &world : worlds) head_for_goals(world, robots, v_max);
      const auto begin = std::chrono::steady_clock::now();
      for (World &world : worlds) world.simulator->doStep();
      spent += std::chrono::steady_clock::now() - begin;
      for (World &world : worlds) {
        robot_steps += world.start.size();
        for (std::size_t i = 0; i < world.start.size(); ++i) neighbours += world.simulator->getAgentNumAgentNeighbors(i);
      }
    }
  }
  std::cout << std::chrono::duration<double>(spent).count() << ' ' << robot_steps << ' '
            << static_cast<double>(neighbours) / static_cast<double>(robot_steps) << std::endl;
}

void once(const Settings &settings) {
  std::size_t robots = 0;
  std::cin >> robots;
  const Simulator simulator = make_simulator(settings, Points(robots));
  for (std::size_t i = 0; i < robots; ++i) {
    simulator->setAgentPosition(i, read_vector());
    simulator->setAgentVelocity(i, read_vector());
    simulator->setAgentPrefVelocity(i, read_vector());
  }
  simulator->doStep();
  for (std::size_t i = 0; i < robots; ++i) {
    const RVO::Vector2 &velocity = simulator->getAgentVelocity(i);
    std::cout << velocity.x() << ' ' << velocity.y() << '\n';
  }
  std::cout << std::flush;
}

}  // namespace

int main() {
  std::ios::sync_with_stdio(false);
  std::cout << std::setprecision(9);
  Settings s{};
  std::size_t num_worlds = 0, robots = 0, groups = 0;
  std::cin >> s.dt >> s.range >> s.max_neighbours >> s.horizon >> s.radius >> s.v_max >> num_worlds >> robots >> groups;
  std::vector<World> worlds(num_worlds);
  for (World &world : worlds) world.start = read_points(robots * groups);
  for (World &world : worlds) world.goals = read_points(groups);
  for (World &world : worlds) world.simulator = make_simulator(s, world.start);
  std::string command;
  while (std::cin >> command) {
    if (command == "run") run(worlds, robots, s.v_max);
    if (command == "once") once(s);
  }
  return 0;
}
