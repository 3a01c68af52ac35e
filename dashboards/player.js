"use strict";
const data = JSON.parse(document.getElementById("data").textContent);
const element = id => document.getElementById(id);
const canvas = element("canvas"), context = canvas.getContext("2d");
const numRobots = data.robots_per_group * data.groups;
const learnerGroup = groupOf(data.learner);
const positions = decodePositions();
const machine = decodeBytes(data.machine);
const STATE_DASHES = [[2, 3], [], [4, 2], [1.5, 2]];
const ARROW_S = 0.6;  // an arrow ends where the robot would be after this time
const show = {sensing: true, velocity: false, machine: false};
let step = 0;        // fractional while playing
let playing = false;
let lastTime = 0;    // ms, of the last frame played
let nextFrame = 0;
let theme = {};

function decodeBytes(text) {
  return Uint8Array.from(atob(text), character => character.charCodeAt(0));
}

function decodePositions() {
  const view = new DataView(decodeBytes(data.positions).buffer);
  const metres = new Float32Array(view.byteLength / 2);
  for (let i = 0; i < metres.length; i++) metres[i] = view.getInt16(2 * i, true) * data.metres_per_unit;
  return metres;
}

function groupOf(robot) { return Math.floor(robot / data.robots_per_group); }
function groupColour(group) { return data.colours[group % data.colours.length]; }
function coordinate(atStep, robot, axis) { return positions[(atStep * numRobots + robot) * 2 + axis]; }

function positionOf(robot, axis) {
  const before = Math.floor(step), after = Math.min(before + 1, data.steps), part = step - before;
  return (1 - part) * coordinate(before, robot, axis) + part * coordinate(after, robot, axis);
}

function velocityOf(robot, axis) {
  const now = Math.floor(step);
  if (now === 0) return 0;
  return (coordinate(now, robot, axis) - coordinate(now - 1, robot, axis)) / data.time_step_s;
}

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["scene", "arena", "edge", "halo", "sensing", "mark", "text", "muted", "success",
                      "state-1", "state-2", "state-3"]) {
    theme[name] = style.getPropertyValue("--" + name).trim();
  }
}

function stateColour(state) { return state === 0 ? theme.muted : theme["state-" + state]; }

// Drawing: metres to CSS pixels, y up.
let pxPerM = 1;
function toX(x) { return (x + data.view_half_m) * pxPerM; }
function toY(y) { return (data.view_half_m - y) * pxPerM; }

function circle(x, y, radius) {
  context.beginPath();
  context.arc(x, y, radius, 0, 2 * Math.PI);
}

function stroke(colour, width, dash = []) {
  context.strokeStyle = colour;
  context.lineWidth = width;
  context.setLineDash(dash);
  context.stroke();
}

function fill(colour) {
  context.fillStyle = colour;
  context.fill();
}

function draw() {
  const size = canvas.clientWidth, density = window.devicePixelRatio || 1, pixels = Math.round(size * density);
  if (!size) return;
  if (canvas.width !== pixels) canvas.width = canvas.height = pixels;
  context.setTransform(density, 0, 0, density, 0, 0);
  context.fillStyle = theme.scene;
  context.fillRect(0, 0, size, size);
  pxPerM = size / (2 * data.view_half_m);
  circle(toX(0), toY(0), data.arena_radius_m * pxPerM);
  stroke(theme.arena, 1.5);
  data.goals.forEach(drawGoal);
  if (show.sensing) drawSensing();
  for (let robot = 0; robot < numRobots; robot++) if (robot !== data.learner) drawRobot(robot);
  drawRobot(data.learner);
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
  for (const radius of [data.outer_radius_m, data.inner_radius_m]) {
    circle(x, y, radius * pxPerM);
    context.globalAlpha = 0.16;
    fill(theme.sensing);
    context.globalAlpha = 0.75;
    stroke(theme.sensing, 1);
    context.globalAlpha = 1;
  }
}

function drawRobot(robot) {
  const x = toX(positionOf(robot, 0)), y = toY(positionOf(robot, 1));
  const radius = Math.max(data.robot_radius_m * pxPerM, 3), colour = groupColour(groupOf(robot));
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
}

function drawVelocity(robot, x, y) {
  const vx = velocityOf(robot, 0) * ARROW_S * pxPerM, vy = -velocityOf(robot, 1) * ARROW_S * pxPerM;
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
  stroke(theme.text, 1.3);
}

function drawState(robot, x, y, radius) {
  const state = machine[Math.floor(step) * numRobots + robot];
  circle(x, y, radius + (robot === data.learner ? 6.5 : 2.5));
  stroke(stateColour(state), state === 0 ? 1.2 : Math.min(2.2, 0.5 * radius), STATE_DASHES[state]);
}

function drawEnd(size) {
  const x = toX(positionOf(data.learner, 0)), y = toY(positionOf(data.learner, 1));
  const success = data.outcome === "goal", colour = success ? theme.success : theme.mark;
  const reach = Math.max(data.robot_radius_m * pxPerM, 3) + 11;
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

// What the player says in words.
function report() {
  const now = Math.floor(step), ended = now === data.steps ? ", " + data.outcome : "";
  const text = "Step " + now + " / " + data.steps + " · " + (now * data.time_step_s).toFixed(2) + " s" + ended;
  if (element("readout").textContent !== text) element("readout").textContent = text;
  element("scrub").value = String(now);
  element("scrub").setAttribute("aria-valuetext", "step " + now + " of " + data.steps);
  canvas.setAttribute("aria-label", text + ". The learning robot is robot " + (data.learner + 1) + " of "
    + numRobots + ", in group " + (learnerGroup + 1) + " of " + data.groups + ".");
  if (show.machine) countStates(now);
}

function countStates(now) {
  const counts = data.states.map(() => 0);
  for (let robot = 0; robot < numRobots; robot++) {
    if (!(robot === data.learner && data.piloted)) counts[machine[now * numRobots + robot]]++;
  }
  counts.forEach((count, state) => { element("state-count-" + state).textContent = String(count); });
}

function addRow(list, drawing, label, note, noteId) {
  const row = document.createElement("li"), text = document.createElement("span"), end = document.createElement("span");
  text.textContent = label;
  end.textContent = note;
  if (noteId) end.id = noteId;
  row.append(drawing, text, end);
  list.append(row);
}

function drawing(...shapes) {
  const space = "http://www.w3.org/2000/svg", svg = document.createElementNS(space, "svg");
  for (const [name, value] of [["width", 20], ["height", 20], ["viewBox", "0 0 20 20"], ["aria-hidden", "true"]]) {
    svg.setAttribute(name, value);
  }
  for (const attributes of shapes) {
    const shape = document.createElementNS(space, "circle");
    for (const [name, value] of Object.entries({cx: 10, cy: 10, ...attributes})) shape.setAttribute(name, value);
    svg.append(shape);
  }
  return svg;
}

function buildLegends() {
  for (let group = 0; group < data.groups; group++) {
    const disc = drawing({r: 6.5, fill: groupColour(group), stroke: "var(--edge)"});
    addRow(element("groups"), disc, "Group " + (group + 1), data.robots_per_group + " robots");
  }
  const ringed = drawing({r: 9, fill: "var(--halo)"}, {r: 8.4, fill: "#000000"},
    {r: 7.4, fill: groupColour(learnerGroup)}, {r: 4.4, fill: "#000000"});
  addRow(element("groups"), ringed, "Learning robot", "group " + (learnerGroup + 1));
  data.states.forEach((name, state) => {
    const colour = state === 0 ? "var(--muted)" : "var(--state-" + state + ")";
    const ring = drawing({r: 7.5, fill: "none", stroke: colour, "stroke-width": state === 0 ? 1.2 : 2.4,
                          "stroke-dasharray": STATE_DASHES[state].join(" ")});
    addRow(element("states"), ring, name, "", "state-count-" + state);
  });
}

// Moving in time.
function seek(target) {
  step = Math.min(Math.max(target, 0), data.steps);
  draw();
}

function setPlaying(value) {
  playing = value;
  cancelAnimationFrame(nextFrame);
  element("play").textContent = playing ? "Pause" : "Play";
  element("readout").setAttribute("aria-live", playing ? "off" : "polite");
  if (!playing) return seek(Math.floor(step));
  if (step >= data.steps) step = 0;
  lastTime = performance.now();
  nextFrame = requestAnimationFrame(advance);
}

function advance(time) {
  if (!playing) return;
  const seconds = Math.min(Math.max(time - lastTime, 0), 250) / 1000;
  lastTime = time;
  seek(step + seconds * Number(element("speed").value) / data.time_step_s);
  if (step >= data.steps) setPlaying(false);
  else nextFrame = requestAnimationFrame(advance);
}

function pauseAt(target) {
  if (playing) setPlaying(false);
  seek(target);
}

// A focused control keeps the keys that it uses itself: space on a button, arrows in a list.
function onKey(event) {
  if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest("select")) return;
  const now = Math.floor(step), stride = event.shiftKey ? 10 : 1;
  const moves = {ArrowLeft: now - stride, ArrowRight: now + stride, Home: 0, End: data.steps};
  if (event.key in moves) {
    pauseAt(moves[event.key]);
  } else if (event.key === " " && !event.target.closest("button, input[type=checkbox]")) {
    setPlaying(!playing);
  } else {
    return;
  }
  event.preventDefault();
}

function start() {
  readTheme();
  buildLegends();
  element("scrub").max = String(data.steps);
  element("scrub").addEventListener("input", event => pauseAt(Number(event.target.value)));
  element("play").addEventListener("click", () => setPlaying(!playing));
  element("back").addEventListener("click", () => pauseAt(Math.floor(step) - 1));
  element("forward").addEventListener("click", () => pauseAt(Math.floor(step) + 1));
  canvas.addEventListener("click", () => setPlaying(!playing));
  for (const name of Object.keys(show)) {
    element(name).addEventListener("change", event => {
      show[name] = event.target.checked;
      element("states-section").hidden = !show.machine;
      draw();
    });
  }
  document.addEventListener("keydown", onKey);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readTheme(); draw(); });
  new ResizeObserver(draw).observe(canvas);
  seek(0);
}
start();
