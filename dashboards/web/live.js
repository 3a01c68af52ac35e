// The page of a running training: plays the newest policy's episodes, one after the other.
"use strict";
const PAUSE_S = 1.5, RETRY_S = 3;
const said = make("span"), nextButton = make("button", {type: "button"}, "Next episode");
let number = 0, policy = null, waiting = 0;

function make(tag, attributes = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...children);
  return node;
}

async function ask(path) {
  const answer = await fetch(path, {cache: "no-cache"}), content = await answer.json();
  if (!answer.ok) throw new Error(content.error);
  return content;
}

async function playNext() {
  clearTimeout(waiting);
  try {
    const episode = await ask("episode.json?number=" + number);
    number++;
    policy = episode.updates;
    await load(episode);
    setPlaying(true);
    await showStatus();
  } catch (error) {
    said.textContent = error instanceof TypeError ? "The server does not answer." : error.message;
    waiting = setTimeout(playNext, 1000 * RETRY_S);
  }
}

async function showStatus() {
  const count = value => value.toLocaleString("en");
  try {
    const {env_steps, total_env_steps, updates} = await ask("status.json");
    const newer = policy !== null && updates !== policy ? `; that of update ${count(updates)} plays next` : "";
    said.textContent = `Training at ${count(env_steps)} of ${count(total_env_steps)} env steps. `
      + (policy === null ? "" : `Playing the policy of update ${count(policy)}${newer}.`);
    element("status").dataset.updates = String(policy);
  } catch (error) {
    said.textContent = "The server does not answer; the training may have ended.";
  }
}

element("status").append(said, " ", nextButton);
element("status").hidden = false;
nextButton.addEventListener("click", playNext);
onEnd = () => { waiting = setTimeout(playNext, 1000 * PAUSE_S); };
setInterval(() => { if (policy !== null && !document.hidden) showStatus(); }, 1000 * RETRY_S);
playNext();
