// ORCA's half-planes of one robot (van den Berg et al. 2011, Section 4), as in sim_core/orca.py: they constrain the
// velocity of the next step, given positions and velocities of the step that is shown.
"use strict";
const space = element("space"), spaceContext = space.getContext("2d");

function neighboursOf(robot, now) {
  const found = [];
  for (let other = 0; other < numRobots; other++) {
    const unseen = other === data.learner && !data.orca.knows_learner;
    const x = coordinate(now, other, 0) - coordinate(now, robot, 0);
    const y = coordinate(now, other, 1) - coordinate(now, robot, 1);
    if (other !== robot && !unseen && Math.hypot(x, y) < data.orca.range_m) found.push({other, x, y});
  }
  return found.sort((a, b) => Math.hypot(a.x, a.y) - Math.hypot(b.x, b.y)).slice(0, data.orca.max_neighbours);
}

// The half-plane of permitted velocities: to the left of the line through (x, y) in the direction (dx, dy), m/s.
function halfPlane(rel, relV, v) {
  const radius = 2 * data.orca.radius_m, distanceSq = rel.x * rel.x + rel.y * rel.y, apart = distanceSq > radius * radius;
  const inverse = 1 / (apart ? data.orca.horizon_s : data.time_step_s);
  const w = {x: relV.x - inverse * rel.x, y: relV.y - inverse * rel.y};
  const length = Math.hypot(w.x, w.y), dot = w.x * rel.x + w.y * rel.y;
  if (!apart || (dot < 0 && dot * dot > radius * radius * length * length)) {
    const unit = {x: w.x / length, y: w.y / length}, push = radius * inverse - length;
    return {x: v.x + push * unit.x / 2, y: v.y + push * unit.y / 2, dx: unit.y, dy: -unit.x};
  }
  const leg = Math.sqrt(distanceSq - radius * radius), left = rel.x * w.y - rel.y * w.x > 0;
  const dx = (left ? rel.x * leg - rel.y * radius : -(rel.x * leg + rel.y * radius)) / distanceSq;
  const dy = (left ? rel.x * radius + rel.y * leg : -(rel.y * leg - rel.x * radius)) / distanceSq;
  const along = relV.x * dx + relV.y * dy;
  return {x: v.x + (along * dx - relV.x) / 2, y: v.y + (along * dy - relV.y) / 2, dx, dy};
}

function halfPlanes(robot, now) {
  const velocity = which => ({x: velocityAt(now, which, 0), y: velocityAt(now, which, 1)}), v = velocity(robot);
  return neighboursOf(robot, now).map(({other, x, y}) => {
    const theirs = velocity(other);
    return halfPlane({x, y}, {x: v.x - theirs.x, y: v.y - theirs.y}, v);
  });
}

function robotAt(x, y) {
  let best = -1, least = robotRadius() + 6;
  for (let robot = 0; robot < numRobots; robot++) {
    const away = Math.hypot(toX(positionOf(robot, 0)) - x, toY(positionOf(robot, 1)) - y);
    if (away < least) [best, least] = [robot, away];
  }
  return best;
}

function drawNeighbours() {
  const x = toX(positionOf(selected, 0)), y = toY(positionOf(selected, 1));
  context.beginPath();
  for (const {other} of neighboursOf(selected, Math.floor(step))) {
    context.moveTo(x, y);
    context.lineTo(toX(positionOf(other, 0)), toY(positionOf(other, 1)));
  }
  stroke(theme.muted, 1, [3, 3]);
}

// Corners of the velocities that all half-planes permit within a square around 0; none if there are no such velocities.
function permitted(planes, half) {
  let corners = [[-half, -half], [half, -half], [half, half], [-half, half]];
  for (const plane of planes) {
    const inside = ([x, y]) => plane.dx * (y - plane.y) - plane.dy * (x - plane.x);
    corners = corners.flatMap((corner, i) => {
      const next = corners[(i + 1) % corners.length], here = inside(corner), there = inside(next);
      const kept = here >= 0 ? [corner] : [];
      if (here >= 0 === there >= 0) return kept;
      const part = here / (here - there);
      return [...kept, [0, 1].map(axis => corner[axis] + part * (next[axis] - corner[axis]))];
    });
  }
  return corners;
}

function drawSpace() {
  const size = prepare(space, spaceContext), now = Math.floor(step), speed = data.orca.max_speed_m_s;
  if (!size) return;
  const piloted = selected === data.learner && data.piloted, planes = piloted ? [] : halfPlanes(selected, now);
  const scale = size / 2 / (1.25 * speed), x = value => size / 2 + value * scale, y = value => size / 2 - value * scale;
  const corners = permitted(planes, 2 * speed);
  spaceContext.beginPath();
  spaceContext.rect(0, 0, size, size);
  corners.forEach((corner, i) => spaceContext[i ? "lineTo" : "moveTo"](x(corner[0]), y(corner[1])));
  spaceContext.closePath();
  spaceContext.globalAlpha = 0.16;
  spaceContext.fillStyle = theme.mark;
  spaceContext.fill("evenodd");
  spaceContext.globalAlpha = 0.75;
  for (const plane of planes) {
    const far = 4 * speed;
    spaceContext.beginPath();
    spaceContext.moveTo(x(plane.x - far * plane.dx), y(plane.y - far * plane.dy));
    spaceContext.lineTo(x(plane.x + far * plane.dx), y(plane.y + far * plane.dy));
    stroke(theme.mark, 1, [], spaceContext);
  }
  spaceContext.globalAlpha = 1;
  circle(x(0), y(0), speed * scale, spaceContext);
  stroke(theme.muted, 1.5, [4, 3], spaceContext);
  circle(x(velocityAt(now, selected, 0)), y(velocityAt(now, selected, 1)), 5.5, spaceContext);
  stroke(theme.text, 1.5, [], spaceContext);
  if (now < data.steps) {
    circle(x(velocityAt(now + 1, selected, 0)), y(velocityAt(now + 1, selected, 1)), 3, spaceContext);
    fill(theme.text, spaceContext);
  }
  element("planes-text").textContent = piloted
    ? "The learning robot follows its policy, not ORCA."
    : planes.length + " lines, one per neighbour" + (corners.length ? "." : "; no velocity satisfies all, so the one that "
      + "violates them least is taken.") + " Dashed: " + speed + " m/s.";
}
