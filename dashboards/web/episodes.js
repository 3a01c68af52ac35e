// The report's episodes: the choice of a policy, setup, outcome and number, and the player.
"use strict";
const FIELDS = [["preset", "Preset"], ["policy", "Policy"], ["method", "Method"], ["trained", "Trained in"],
  ["seed", "Training seed"], ["played", "Tested in"]];
const OUTCOMES = ["goal", "lost", "captured", "collision", "timeout", "running"];

const episodes = {
  groups: [], samples: null, chosen: {}, shown: "", asked: 0,

  update({groups, note}) {
    if (this.samples === null) this.samples = JSON.parse(element("samples").textContent);
    this.groups = groups;
    element("episodes").hidden = groups.length === 0;
    element("episodes-note").textContent = note;
    if (!groups.length) return;
    const playable = groups.filter(group => OUTCOMES.some(outcome => this.available(group, outcome)));
    const favourite = playable.find(group => group.played === content.favourite && group.trained === group.played);
    if (!this.chosen.method && playable.length) this.chosen = {...(favourite || playable[0]), number: 0};
    this.show();
  },

  choose(values) {
    const wanted = {...this.chosen, ...values};
    if (!this.groups.some(group => Object.keys(values).every(name => group[name] === values[name]))) return;
    this.chosen = {...wanted, number: 0};
    this.show();
  },

  // Applies the choices one by one, each among the groups that the earlier ones leave. A choice that is not among them
  // is replaced by the first.
  narrow() {
    let left = this.groups;
    const offered = [];
    for (const [field, label] of FIELDS) {
      const values = [...new Set(left.map(group => group[field]))];
      if (!values.includes(this.chosen[field])) this.chosen[field] = values[0];
      if (values.length > 1) offered.push([field, label, values]);
      left = left.filter(group => group[field] === this.chosen[field]);
    }
    return {group: left[0], offered};
  },

  show() {
    const {group, offered} = this.narrow(), counts = OUTCOMES.filter(outcome => group.counts[outcome]);
    if (!counts.includes(this.chosen.outcome)) {
      this.chosen.outcome = counts.find(outcome => this.available(group, outcome)) || counts[0];
    }
    const have = this.available(group, this.chosen.outcome);
    this.chosen.number = Math.max(0, Math.min(this.chosen.number || 0, have - 1));
    const set = field => value => {
      this.chosen = {...this.chosen, [field]: value, number: 0};
      this.show();
    };
    const selects = offered.map(([field, label, values]) => makeSelect(label,
      values.map(value => [value, field === "method" ? content.methods[value] : value]), this.chosen[field], set(field)));
    const outcomes = counts.map(outcome => [outcome, outcome + " (" + group.counts[outcome].toLocaleString("en") + ")"]);
    selects.push(makeSelect("Outcome", outcomes, this.chosen.outcome, set("outcome")));
    const focused = document.activeElement?.getAttribute("aria-label");
    element("episode-choices").replaceChildren(...selects, ...this.steppers(have));
    if (focused) element("episode-choices").querySelector(`[aria-label="${focused}"]`)?.focus();
    this.play(group, have);
  },

  // Number of episodes of an outcome that can be played: all on a served page, else those embedded in the file.
  available(group, outcome) {
    if (REFRESH_S > 0) return group.counts[outcome] || 0;
    let count = 0;
    while (`${group.key}|${outcome}|${count}` in this.samples) count++;
    return count;
  },

  steppers(have) {
    const move = by => {
      this.chosen.number = (this.chosen.number + by + have) % have;
      this.show();
    };
    return [["‹", "Previous episode", -1], ["›", "Next episode", 1]].map(([text, label, by]) => {
      const button = make("button", {type: "button", "aria-label": label, title: label}, text);
      button.disabled = have < 2;
      button.addEventListener("click", () => move(by));
      return button;
    });
  },

  async play(group, have) {
    const {outcome, number} = this.chosen, key = `${group.key}|${outcome}|${number}`, ask = ++this.asked;
    const missing = element("episode-missing");
    const place = have > 1 ? `Episode ${number + 1} of ${have.toLocaleString("en")}` : "";
    missing.textContent = have ? place : "No episode of this outcome is in this file; `shoal dashboard --serve` plays all.";
    element("player").hidden = !have;
    if (!have || key === this.shown) return;
    try {
      const episode = this.samples[key] || await this.fetched(group.key, outcome, number);
      if (ask !== this.asked) return;  // another episode has been chosen meanwhile
      this.shown = key;
      await load(episode);
    } catch (error) {
      missing.textContent = "This episode cannot be shown: " + error.message;
      element("player").hidden = true;
    }
  },

  async fetched(key, outcome, number) {
    element("episode-missing").textContent = "Playing the episode …";
    const answer = await fetch("episode.json?" + new URLSearchParams({key, outcome, number}));
    const episode = await answer.json();
    if (!answer.ok) throw new Error(episode.error);
    element("episode-missing").textContent = `Episode ${number + 1} of ${content.episodes.groups
      .find(group => group.key === key).counts[outcome].toLocaleString("en")}`;
    return episode;
  },
};
startReport();
