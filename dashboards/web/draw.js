// Draws the scene on the canvas. x and y are in metres, y upwards; toX and toY give CSS pixels.
"use strict";
const STATE_DASHES = [[2, 3], [], [4, 2], [1.5, 2]];
const CLOSE_UP = 3;  // magnification of a close-up
let pxPerM = 1;
const centre = {x: 0, y: 0};

function toX(x) { return canvas.clientWidth / 2 + (x - centre.x) * pxPerM; }
function toY(y) { return canvas.clientWidth / 2 - (y - centre.y) * pxPerM; }
function stateVariable(state) { return state === 0 ? "var(--muted)" : "var(--state-" + state + ")"; }
function stateColour(state) { return state === 0 ? theme.muted : theme["state-" + state]; }
function robotRadius() { return Math.max(data.robot_radius_m * pxPerM, 3); }

function circle(x, y, radius, on = context) {
  on.beginPath();
  on.arc(x, y, radius, 0, 2 * Math.PI);
}

function stroke(colour, width, dash = [], on = context) {
  on.strokeStyle = colour;
  on.lineWidth = width;
  on.setLineDash(dash);
  on.stroke();
}

function fill(colour, on = context) {
  on.fillStyle = colour;
  on.fill();
}

// Sets a canvas to the screen's resolution and clears it; returns its edge in CSS pixels, 0 if it is hidden.
function prepare(target, on) {
  const size = target.clientWidth, density = window.devicePixelRatio || 1, pixels = Math.round(size * density);
  if (!size) return 0;
  if (target.width !== pixels) target.width = target.height = pixels;
  on.setTransform(density, 0, 0, density, 0, 0);
  on.fillStyle = theme.scene;
  on.fillRect(0, 0, size, size);
  return size;
}

function draw() {
  if (!data) return;
  const size = prepare(canvas, context);
  if (!size) return;
  const zoom = show.follow ? CLOSE_UP : 1;
  pxPerM = zoom * size / (2 * data.view_half_m);
  centre.x = show.follow ? positionOf(data.learner, 0) : 0;
  centre.y = show.follow ? positionOf(data.learner, 1) : 0;
  if (data.arena_radius_m !== null) {
    circle(toX(0), toY(0), data.arena_radius_m * pxPerM);
    stroke(theme.arena, 1.5);
  }
  data.goals.forEach(drawGoal);
  if (show.sensing) drawSensing();
  if (show.ellipses && data.ellipse) for (let group = 0; group < data.groups; group++) drawEllipse(group);
  if (show.planes) drawNeighbours();
  for (let robot = 0; robot < numRobots; robot++) if (robot !== data.learner) drawRobot(robot);
  if (show.sensed && sensed) drawSensed();
  drawRobot(data.learner);
  if (show.planes) drawSpace();
  onDraw();
  if (step >= data.steps) drawEnd(size);
  report();
}

function drawGoal([x, y], group) {
  const half = Math.max(data.goal_half_m * pxPerM, 7), line = Math.max(2, half / 4);
  const square = inset => {
    context.beginPath();
    context.rect(toX(x) - half + inset, toY(y) - half + inset, 2 * (half - inset), 2 * (half - inset));
  };
  if (group === learnerGroup) {
    square(line / 2);
    stroke(theme.halo, line + 6);
    square(line / 2);
    stroke("#000000", line + 3);
  }
  square(line / 2);
  stroke(groupColour(group), line);
  context.fillStyle = theme.text;
  context.font = "600 " + Math.max(9, 0.9 * half) + "px system-ui, sans-serif";
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.fillText(String(group + 1), toX(x), toY(y) + 1);
}

function drawSensing() {
  const x = toX(positionOf(data.learner, 0)), y = toY(positionOf(data.learner, 1));
  const inner = data.inner_radius_m * pxPerM, outer = data.outer_radius_m * pxPerM;
  for (const radius of [outer, inner]) {
    circle(x, y, radius);
    context.globalAlpha = 0.16;
    fill(theme.sensing);
    context.globalAlpha = 0.75;
    stroke(theme.sensing, 1);
    context.globalAlpha = 1;
  }
  if (data.draws_sectors) drawSectors(x, y, outer);
  const action = actions[Math.floor(step)];
  const level = Math.floor(action / data.sectors), share = 1 - level / data.speed_levels;
  if (action >= 0 && share > 0) drawHeading(x, y, inner * share, headingOf(action % data.sectors));
}

// The angle from which sectors are counted: 0, or the direction of the learning robot's goal.
function frameTurn() {
  if (!data.sectors_face_goal) return 0;
  const [goalX, goalY] = data.goals[learnerGroup];
  return Math.atan2(goalY - positionOf(data.learner, 1), goalX - positionOf(data.learner, 0));
}

function headingOf(action) {
  return Math.PI / data.sectors + action * 2 * Math.PI / data.sectors - Math.PI + frameTurn();
}

function drawSectors(x, y, radius) {
  context.beginPath();
  for (let sector = 0; sector < data.sectors; sector++) {
    const turn = sector * 2 * Math.PI / data.sectors - Math.PI + frameTurn();
    context.moveTo(x, y);
    context.lineTo(x + radius * Math.cos(turn), y - radius * Math.sin(turn));
  }
  context.globalAlpha = 0.4;
  stroke(theme.sensing, 1);
  context.globalAlpha = 1;
}

// Draws the action of this step: the heading in the middle of its sector.
function drawHeading(x, y, inner, turn) {
  const from = robotRadius() + 6, to = Math.max(inner, from + 10);
  context.lineCap = "round";
  context.beginPath();
  context.moveTo(x + from * Math.cos(turn), y - from * Math.sin(turn));
  context.lineTo(x + to * Math.cos(turn), y - to * Math.sin(turn));
  stroke(theme.halo, 5);
  stroke(theme.text, 2.5);
  context.lineCap = "butt";
}

// A group's ellipse as in sim_core/methods/ellipse.py: centre, half-axes, and the angle of the major axis.
function ellipseOf(group) {
  const robots = [];
  for (let robot = 0; robot < numRobots; robot++) {
    if (groupOf(robot) === group && (robot !== data.learner || data.ellipse.counts_learner)) robots.push(robot);
  }
  const mean = values => values.reduce((sum, value) => sum + value, 0) / robots.length;
  const xs = robots.map(robot => positionOf(robot, 0)), ys = robots.map(robot => positionOf(robot, 1));
  const x = mean(xs), y = mean(ys), freedom = Math.max(robots.length - 1, 1);
  const covariance = (a, b) => a.reduce((sum, value, i) => sum + value * b[i], 0) / freedom;
  const dx = xs.map(value => value - x), dy = ys.map(value => value - y);
  const xx = covariance(dx, dx), yy = covariance(dy, dy), xy = data.ellipse.full ? covariance(dx, dy) : 0;
  const middle = (xx + yy) / 2, half = (xx - yy) / 2, root = Math.hypot(half, xy);
  const axis = variance => Math.max(data.ellipse.axis_scale * Math.sqrt(Math.max(variance, 0)), data.ellipse.smallest_m);
  return {x, y, major: axis(middle + root), minor: axis(middle - root), turn: Math.atan2(xy, half) / 2};
}

function drawEllipse(group) {
  const {x, y, major, minor, turn} = ellipseOf(group), own = group === learnerGroup;
  context.beginPath();
  context.ellipse(toX(x), toY(y), major * pxPerM, minor * pxPerM, -turn, 0, 2 * Math.PI);
  context.globalAlpha = own ? 0.14 : 0.06;
  fill(groupColour(group));
  context.globalAlpha = 1;
  stroke(groupColour(group), own ? 2.2 : 1.3, own ? [] : [5, 4]);
}

// Draws what the learning robot senses: a dashed ring where it takes a robot to be, tied to where that robot is; a robot
// that it does not sense is struck out.
function drawSensed() {
  const now = Math.floor(step), radius = robotRadius();
  for (let robot = 0; robot < numRobots; robot++) {
    if (robot === data.learner) continue;
    const x = toX(coordinate(now, robot, 0)), y = toY(coordinate(now, robot, 1)), at = (now * numRobots + robot) * 2;
    context.beginPath();
    if (Number.isNaN(sensed[at])) {
      context.moveTo(x - radius, y - radius);
      context.lineTo(x + radius, y + radius);
      stroke(theme.text, 1.5);
      continue;
    }
    const sensedX = toX(sensed[at]), sensedY = toY(sensed[at + 1]);
    context.moveTo(x, y);
    context.lineTo(sensedX, sensedY);
    stroke(theme.muted, 1);
    circle(sensedX, sensedY, radius + 2);
    stroke(groupColour(groupOf(robot)), 1.5, [3, 2]);
  }
}

function drawRobot(robot) {
  const x = toX(positionOf(robot, 0)), y = toY(positionOf(robot, 1));
  const radius = robotRadius(), colour = groupColour(groupOf(robot));
  if (show.velocity) drawVelocity(robot, x, y);
  if (robot === data.learner) {
    circle(x, y, radius + 4.5);
    fill(theme.halo);
    circle(x, y, radius + 3.5);
    fill("#000000");
    circle(x, y, radius + 2.5);
    fill(colour);
    circle(x, y, radius);
    fill("#000000");
  } else {
    circle(x, y, radius);
    fill(colour);
    stroke(theme.edge, 0.8);
  }
  if (show.machine && !(robot === data.learner && data.piloted)) drawState(robot, x, y, radius);
  if (show.planes && robot === selected) {
    circle(x, y, radius + (robot === data.learner ? 7.5 : 3.5));
    stroke(theme.text, 2);
  }
}

function drawVelocity(robot, x, y) {
  const now = Math.floor(step);
  drawArrow(x, y, velocityAt(now, robot, 0), velocityAt(now, robot, 1), []);
  if (robot === data.learner && asked) {  // that of the last step, as the velocity is
    const at = 2 * Math.max(now - 1, 0);
    drawArrow(x, y, asked[at] / 1000, asked[at + 1] / 1000, [3, 3]);
  }
}

function drawArrow(x, y, velocityX, velocityY, dash) {
  const scale = ARROW_S * pxPerM, vx = velocityX * scale, vy = -velocityY * scale;
  const length = Math.hypot(vx, vy);
  if (length < 1) return;
  const head = Math.min(5, length / 2), turn = Math.atan2(vy, vx);
  context.beginPath();
  context.moveTo(x, y);
  context.lineTo(x + vx, y + vy);
  for (const side of [-2.6, 2.6]) {
    context.moveTo(x + vx, y + vy);
    context.lineTo(x + vx + head * Math.cos(turn + side), y + vy + head * Math.sin(turn + side));
  }
  stroke(theme.text, 1.3, dash);
}

function drawState(robot, x, y, radius) {
  const state = machine[Math.floor(step) * numRobots + robot];
  circle(x, y, radius + (robot === data.learner ? 6.5 : 2.5));
  stroke(stateColour(state), state === 0 ? 1.2 : Math.min(2.2, 0.5 * radius), STATE_DASHES[state]);
}

function drawEnd(size) {
  const x = toX(positionOf(data.learner, 0)), y = toY(positionOf(data.learner, 1));
  const success = data.outcome === "goal", colour = success ? theme.success : theme.mark;
  const reach = robotRadius() + 11;
  context.lineCap = "round";
  circle(x, y, reach);
  stroke(colour, 3);
  if (!success) {
    context.beginPath();
    for (const side of [-1, 1]) {
      context.moveTo(x - 0.7 * reach, y - 0.7 * reach * side);
      context.lineTo(x + 0.7 * reach, y + 0.7 * reach * side);
    }
    stroke(colour, 3);
  }
  context.lineCap = "butt";
  context.font = "700 15px system-ui, sans-serif";
  const text = data.outcome === "running" ? "cut" : data.outcome, half = context.measureText(text).width / 2 + 4;
  context.textAlign = "center";
  context.textBaseline = "middle";
  const textX = Math.min(Math.max(x, half), size - half), textY = y < 50 ? y + reach + 14 : y - reach - 12;
  context.strokeStyle = theme.scene;
  context.lineWidth = 4;
  context.setLineDash([]);
  context.strokeText(text, textX, textY);
  context.fillStyle = colour;
  context.fillText(text, textX, textY);
}
