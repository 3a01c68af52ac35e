// The page on which a person drives the learning robot. This page keeps the time: it asks for one decision after the
// other. When a scene ends, all players' episodes of it are shown, and the score sheet.
"use strict";
const PERSON = "you", DIRECTIONS = {ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1]};
const message = make("span"), nextButton = make("button", {type: "button", hidden: ""}, "Next scene");
const choices = make("p", {id: "players", role: "group", "aria-label": "Whose episode"});
const sheet = make("section", {id: "sheet", "aria-label": "Score sheet"});
const held = new Set();  // arrow keys that are down
let pointer = null;      // where the pointer is held down, CSS pixels of the canvas; null if it is not
let number = null;       // of the scene
let driving = false;     // a scene runs, or waits for the first key
let paused = true;
let moving = false;      // `drive` asks for decisions, or has not noticed a pause yet
let paths = null;        // of the learning robot by player, metres, while a scene that has ended is shown
let shown = null;        // the player whose episode is shown

function tell(error) {
  driving = false;
  document.body.dataset.driving = "no";
  message.textContent = reason(error);
}

const wait = seconds => new Promise(done => setTimeout(done, 1000 * seconds));

// Shows the score sheet, and the next scene unless all are driven.
async function beginNext() {
  const scores = await request("sheet.json");
  showSheet(scores);
  number = scores.next;
  nextButton.hidden = true;
  if (number === null) {
    message.textContent = "All " + scores.scenes + " scenes are driven. Another --seed has other scenes.";
    return;
  }
  paths = shown = null;
  choices.replaceChildren();
  const first = await request("begin.json", {number});
  await load(first);
  makeRoom(first.horizon_steps);
  element("verdict").textContent = "";
  message.textContent = "Scene " + (number + 1) + " of " + scores.scenes + ": hold arrow keys, or press on the scene, to "
    + "drive the ringed robot with its group to its goal. Space pauses.";
  document.body.dataset.driving = "yes";
  held.clear();
  pointer = null;
  paused = driving = true;
}

// Makes room for the states of a whole episode, of which the first is there.
function makeRoom(steps) {
  const grown = (old, type, filler = 0) => {
    const room = new type(old.length * (steps + 1)).fill(filler);
    room.set(old);
    return room;
  };
  positions = grown(positions, Float32Array);
  machine = grown(machine, Uint8Array);
  actions = grown(actions, Int16Array, -1);
  sensed = sensed && grown(sensed, Float32Array);
  asked = null;
  data.steps = steps;
  data.piloted = true;
  element("scrub").max = String(steps);
  seek(0);
}

// The direction in which the person drives: sum of the arrows that are down, or towards the pointer; length 1 or 0.
function direction() {
  let [x, y] = [...held].reduce((sum, key) => [sum[0] + DIRECTIONS[key][0], sum[1] + DIRECTIONS[key][1]], [0, 0]);
  if (pointer) {
    [x, y] = [pointer.x - toX(positionOf(data.learner, 0)), toY(positionOf(data.learner, 1)) - pointer.y];
    if (Math.hypot(x, y) < robotRadius()) return {x: 0, y: 0};
  }
  const length = Math.hypot(x, y) || 1;
  return {x: x / length, y: y / length};
}

// Drives until the scene ends or a pause.
async function drive() {
  paused = false;
  if (moving) return;
  moving = true;
  try {
    while (driving && !paused) {
      const began = performance.now(), now = step;
      const made = await request("move.json", {step: now, ...direction()});
      made.positions.forEach((state, i) => {
        positions.set(state, 2 * numRobots * (now + 1 + i));
        machine.set(made.machine[i], numRobots * (now + 1 + i));
        if (sensed) sensed.set(made.sensed[i].map(value => value ?? NaN), 2 * numRobots * (now + 1 + i));
      });
      seek(now + made.positions.length);
      if (made.outcome !== "running") return showEnd();
      const due = made.positions.length * data.time_step_s / Number(element("speed").value);
      await wait(Math.max(due - (performance.now() - began) / 1000, 0));
    }
  } finally {
    moving = false;
  }
}

// Shows what all players did on the scene that has ended: one's episode, the others' robots as rings on their paths.
async function showEnd() {
  driving = false;
  document.body.dataset.driving = "no";
  const scores = await request("sheet.json");
  paths = await request("paths.json?number=" + number);
  showSheet(scores);
  const results = scores.rows.find(row => row.number === number).results;
  choices.replaceChildren(...scores.players.map(player => {
    const button = make("button", {type: "button"}, player + ": " + resultText(results[player]));
    button.addEventListener("click", () => watch(player).catch(tell));
    button.dataset.player = player;
    return button;
  }));
  message.textContent = "Scene " + (number + 1) + " of " + scores.scenes + " is over.";
  nextButton.textContent = scores.next === null ? "Finish" : "Next scene";
  nextButton.hidden = false;
  nextButton.focus();
  await watch(PERSON);
}

async function watch(player) {
  await load(await request("episode.json?number=" + number + "&player=" + player));
  shown = player;
  for (const button of choices.children) button.setAttribute("aria-pressed", String(button.dataset.player === player));
  setPlaying(true);
}

function resultText(result) {
  return result.outcome === "goal" ? "goal in " + result.time_s.toFixed(1) + " s" : result.outcome;
}

// Draws the learning robots of the players that are not shown, where they were at this time.
onDraw = () => {
  if (!paths) return;
  let colour = 0;
  for (const [player, path] of Object.entries(paths)) {
    const ink = theme["other-" + (1 + colour++ % 3)], last = Math.min(Math.floor(step), path.length - 1);
    if (player === shown) continue;
    context.beginPath();
    for (let i = 0; i <= last; i++) context.lineTo(toX(path[i][0]), toY(path[i][1]));
    stroke(ink, 1.3, [2, 3]);
    const x = toX(path[last][0]), y = toY(path[last][1]);
    circle(x, y, robotRadius() + 2);
    stroke(ink, 2);
    context.font = "600 11px system-ui, sans-serif";
    context.textAlign = "left";
    context.textBaseline = "middle";
    context.fillStyle = ink;
    context.fillText(player, x + robotRadius() + 6, y);
  }
};

function tableRow(tag, cells) {
  return make("tr", {}, ...cells.map((cell, i) => make(i ? tag : "th", i ? {} : {scope: "row"}, cell)));
}

function showSheet(scores) {
  const shortened = (value, digits) => value === null ? "–" : value.toFixed(digits);
  const totals = make("table", {id: "totals"}, tableRow("th", ["", "success", "mean time of successes, s",
    "nearest to the goal, mean, m", "nearest to another robot, mean, m"]));
  for (const {player, scenes, successes, time_s, goal_m, gap_m} of scores.totals) {
    const cells = [successes + " of " + scenes, shortened(time_s, 1), shortened(goal_m, 2), shortened(gap_m, 2)];
    totals.append(tableRow("td", [player, ...cells]));
  }
  const table = make("table", {id: "scenes"}, tableRow("th", ["scene", ...scores.players]));
  for (const row of scores.rows) {
    table.append(tableRow("td", [String(row.number + 1), ...scores.players.map(name => resultText(row.results[name]))]));
  }
  const none = make("p", {class: "hint"}, "Once a scene is driven, all players' success and time and how near they came stand here.");
  sheet.replaceChildren(make("h2", {}, "Score sheet"), ...(scores.rows.length ? [totals, table] : [none]));
}

// Keys and pointer, before the player takes them.
function onKeyDown(event) {
  if (!driving || event.ctrlKey || event.altKey || event.metaKey || event.target.closest("select")) return;
  if (event.key in DIRECTIONS) {
    held.add(event.key);
    if (paused) drive().catch(tell);
  } else if (event.key === " ") {
    paused = true;
  } else {
    return;
  }
  event.preventDefault();
  event.stopImmediatePropagation();
}

function onPointer(event) {
  if (!driving) return;
  pointer = event.buttons & 1 ? {x: event.offsetX, y: event.offsetY} : null;
  if (pointer && paused && event.type === "pointerdown") drive().catch(tell);
}

function letGo() {
  held.clear();
  pointer = null;
  if (driving) paused = true;
}

function startDriving() {
  element("status").append(message, " ", nextButton);
  element("status").hidden = false;
  element("player").before(choices);
  element("player").after(sheet);
  element("speed").value = "1";
  canvas.style.touchAction = "none";
  document.addEventListener("keydown", onKeyDown, true);
  document.addEventListener("keyup", event => held.delete(event.key), true);
  for (const type of ["pointerdown", "pointermove", "pointerup", "pointercancel"]) canvas.addEventListener(type, onPointer);
  canvas.addEventListener("click", event => { if (driving) event.stopImmediatePropagation(); }, true);
  window.addEventListener("blur", letGo);
  nextButton.addEventListener("click", () => beginNext().catch(tell));
  beginNext().catch(tell);
}
startDriving();
