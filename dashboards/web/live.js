// The live page of a running training: plays episodes of the newest policy, one after the other.
"use strict";
const PAUSE_S = 1.5, RETRY_S = 3;
const message = make("span"), nextButton = make("button", {type: "button"}, "Next episode");
let number = 0;      // of the next episode
let policy = null;   // updates of the policy that is playing
let timer = 0;       // of the next episode

async function playNext() {
  clearTimeout(timer);
  try {
    const episode = await request("episode.json?number=" + number);
    number++;
    policy = episode.updates;
    await load(episode);
    setPlaying(true);
    await showStatus();
  } catch (error) {
    message.textContent = reason(error);
    timer = setTimeout(playNext, 1000 * RETRY_S);
  }
}

async function showStatus() {
  const count = value => value.toLocaleString("en");
  try {
    const {env_steps, total_env_steps, updates} = await request("status.json");
    const newer = policy !== null && updates !== policy ? `; that of update ${count(updates)} plays next` : "";
    message.textContent = `Training at ${count(env_steps)} of ${count(total_env_steps)} env steps. `
      + (policy === null ? "" : `Playing the policy of update ${count(policy)}${newer}.`);
    element("status").dataset.updates = String(policy);
  } catch (error) {
    message.textContent = "The server does not answer; the training may have ended.";
  }
}

element("status").append(message, " ", nextButton);
element("status").hidden = false;
nextButton.addEventListener("click", playNext);
onEnd = () => { timer = setTimeout(playNext, 1000 * PAUSE_S); };
setInterval(() => { if (policy !== null && !document.hidden) showStatus(); }, 1000 * RETRY_S);
playNext();
