// The player: the loaded episode, the step that is shown, and the controls. draw.js and orca.js draw it.
"use strict";
const canvas = element("canvas"), context = canvas.getContext("2d");
const NOWHERE = -32768;  // in place of a position: the robot is not sensed
const ARROW_S = 0.6;  // an arrow of velocity ends where the robot would be after this time
const show = {sensing: true, sensed: true, ellipses: true, velocity: false, machine: false, planes: false, follow: false};
let data = null;     // the episode, as from player_data in dashboards/pages/player.py
let groupOfRobot = [], numRobots = 0, learnerGroup = 0, positions = null, machine = null, actions = null;
let sensed = null;   // positions as the learning robot senses them, metres; null if it senses well
let asked = null;    // velocity asked for before shield or unicycle, mm/s; null without
let selected = 0;    // robot whose ORCA lines are shown
let step = 0;        // step that is shown; fractional while playing
let playing = false;
let lastTime = 0;    // time of the last frame played, ms
let nextFrame = 0;
let onEnd = () => {};   // called when playing reaches the last step
let onDraw = () => {};  // called when the scene is drawn
const theme = {};

// Positions in metres from their packed form: int16 differences from step to step, low bytes before high bytes. Sums
// wrap around as int16. NOWHERE becomes NaN.
function decodePositions(bytes) {
  const count = bytes.length / 2, stride = 2 * numRobots, units = new Int16Array(count), metres = new Float32Array(count);
  for (let i = 0; i < count; i++) {
    units[i] = (bytes[i] | bytes[count + i] << 8) + (i < stride ? 0 : units[i - stride]);
    metres[i] = units[i] === NOWHERE ? NaN : units[i] * data.metres_per_unit;
  }
  return metres;
}

async function load(next) {
  const planes = await inflate(next.positions), states = await inflate(next.machine);
  const taken = new Int16Array((await inflate(next.actions)).buffer);
  const senses = next.sensed && await inflate(next.sensed), wishes = next.asked && await inflate(next.asked);
  setPlaying(false);
  data = next;
  groupOfRobot = data.group_sizes.flatMap((size, group) => Array(size).fill(group));
  numRobots = groupOfRobot.length;
  learnerGroup = groupOf(data.learner);
  positions = decodePositions(planes);
  machine = states;
  actions = taken;
  sensed = senses && decodePositions(senses);
  asked = wishes && new Int16Array(wishes.buffer);
  selectRobot(nearestToLearner());
  element("setup").textContent = data.setup;
  element("verdict").textContent = data.verdict;
  element("verdict").className = "verdict " + (data.outcome === "goal" ? "success" : "failure");
  element("ellipses-toggle").hidden = !data.ellipse;
  element("sensed-toggle").hidden = !sensed;
  element("asked-note").hidden = !asked;
  element("scrub").max = String(data.steps);
  element("robot").max = String(numRobots);
  buildLegends();
  seek(0);
}

function groupOf(robot) { return groupOfRobot[robot]; }
function groupColour(group) { return data.colours[group % data.colours.length]; }
function coordinate(atStep, robot, axis) { return positions[(atStep * numRobots + robot) * 2 + axis]; }

function positionOf(robot, axis) {
  const before = Math.floor(step), after = Math.min(before + 1, data.steps), part = step - before;
  return (1 - part) * coordinate(before, robot, axis) + part * coordinate(after, robot, axis);
}

function velocityAt(now, robot, axis) {
  if (now === 0) return 0;
  return (coordinate(now, robot, axis) - coordinate(now - 1, robot, axis)) / data.time_step_s;
}

function nearestToLearner() {
  let best = data.learner === 0 ? 1 : 0, least = Infinity;
  for (let robot = 0; robot < numRobots; robot++) {
    const away = Math.hypot(...[0, 1].map(axis => coordinate(0, robot, axis) - coordinate(0, data.learner, axis)));
    if (robot !== data.learner && away < least) [best, least] = [robot, away];
  }
  return best;
}

function selectRobot(robot) {
  selected = Math.min(Math.max(robot, 0), numRobots - 1);
  element("robot").value = String(selected + 1);
}

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  for (const name of ["scene", "arena", "edge", "halo", "sensing", "mark", "text", "muted", "success", "line",
                      "state-1", "state-2", "state-3", "other-1", "other-2", "other-3"]) {
    theme[name] = style.getPropertyValue("--" + name).trim();
  }
}

// Updates the texts: step, time, outcome, and the canvas's label.
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
  for (const list of ["groups", "states"]) element(list).replaceChildren();
  for (let group = 0; group < data.groups; group++) {
    const disc = drawing({r: 6.5, fill: groupColour(group), stroke: "var(--edge)"});
    addRow(element("groups"), disc, "Group " + (group + 1), data.group_sizes[group] + " robots");
  }
  const ringed = drawing({r: 9, fill: "var(--halo)"}, {r: 8.4, fill: "#000000"},
    {r: 7.4, fill: groupColour(learnerGroup)}, {r: 4.4, fill: "#000000"});
  addRow(element("groups"), ringed, "Learning robot", "group " + (learnerGroup + 1));
  data.states.forEach((name, state) => {
    const ring = drawing({r: 7, fill: "none", stroke: stateVariable(state), "stroke-width": state === 0 ? 1.4 : 2.4,
      "stroke-dasharray": STATE_DASHES[state].join(" ")});
    addRow(element("states"), ring, name, "", "state-count-" + state);
  });
}

// Time.
function seek(target) {
  step = Math.min(Math.max(target, 0), data.steps);
  draw();
}

function setPlaying(value) {
  playing = value;
  cancelAnimationFrame(nextFrame);
  element("play").textContent = playing ? "Pause" : "Play";
  element("readout").setAttribute("aria-live", playing ? "off" : "polite");
  if (!data) return;
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
  if (step < data.steps) {
    nextFrame = requestAnimationFrame(advance);
  } else {
    setPlaying(false);
    onEnd();
  }
}

function pauseAt(target) {
  if (playing) setPlaying(false);
  seek(target);
}

// Keys work everywhere on a page of the player alone; on a page with other content, inside the player only. A focused
// control keeps its own keys: space on a button, arrows in a list.
function onKey(event) {
  if (!data || event.ctrlKey || event.altKey || event.metaKey) return;
  if (event.target.closest("select, input[type=number]")) return;
  if (document.body.dataset.keys !== "page" && !event.target.closest("#player")) return;
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

function onCanvasClick(event) {
  if (!data) return;
  const robot = show.planes ? robotAt(event.offsetX, event.offsetY) : -1;
  if (robot < 0) return setPlaying(!playing);
  selectRobot(robot);
  draw();
}

function startPlayer() {
  readTheme();
  element("scrub").addEventListener("input", event => pauseAt(Number(event.target.value)));
  element("play").addEventListener("click", () => setPlaying(!playing));
  element("back").addEventListener("click", () => pauseAt(Math.floor(step) - 1));
  element("forward").addEventListener("click", () => pauseAt(Math.floor(step) + 1));
  element("robot").addEventListener("input", event => { selectRobot(Number(event.target.value) - 1); draw(); });
  canvas.addEventListener("click", onCanvasClick);
  for (const name of Object.keys(show)) {
    element(name).addEventListener("change", event => {
      show[name] = event.target.checked;
      element("states-section").hidden = !show.machine;
      element("planes-section").hidden = !show.planes;
      draw();
    });
  }
  document.addEventListener("keydown", onKey);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => { readTheme(); draw(); });
  new ResizeObserver(draw).observe(canvas);
}
startPlayer();
