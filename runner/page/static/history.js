// The recordings beside the running one, and one of them told again.

import {asked} from "./asked.js";
import {html, nothing} from "./lit-html.js";
import {engineers, lasted, size, solid} from "./parts.js";
import {notice, question, statements, view} from "./scene.js";

const WORDS = {COMPLETE: "complete", INCOMPLETE: "incomplete"};
const READING_MS = 120_000; // that a recording may take to be read
const LONGEST_MS = 2000; // that a moment is shown while it plays

export function history(page) {
  return page.past ? replayed(page, page.past) : list(page);
}

function list(page) {
  const runs = page.runs ?? [];
  const when = new Intl.DateTimeFormat(page.language, {dateStyle: "medium", timeStyle: "short"});
  return html`<section aria-labelledby="runs"><h2 id="runs">${page.say("runs")}</h2>
    <p class="quiet">${page.say("runs_hint")}</p>
    ${page.unread ? unread(page, page.unread, () => listed(page)) : nothing}
    <ul class="runs">${runs.map((run) => html`<li>
      <b>${when.format(new Date(1000 * run.started))}</b>
      <span>${run.graph || run.name}</span>
      <span>${run.running ? page.say("running") : lasted(run.seconds)}</span>
      <span class="sure ${run.verdict === "COMPLETE" ? "sure" : run.running ? "unsure" : "doubtful"}">
        ${run.running ? page.say("being_written") : page.say(WORDS[run.verdict] ?? "torn")}</span>
      <span><a href="#history/${encodeURIComponent(run.name)}">${page.say("replay")}<span class="unseen"> ${run.name}</span></a>
      ${run.running ? nothing : html` · <a href="runs/${encodeURIComponent(run.name)}.mcap" download
        >${page.say("download", {size: size(run.bytes)})}<span class="unseen"> ${run.name}</span></a>`}</span>
    </li>`)}</ul></section>`;
}

/** Asks for the list. */
export async function listed(page) {
  page.unread = "";
  try {
    page.runs = JSON.parse(await asked(page, "runs"));
  } catch (error) {
    page.unread = error.message;
  }
  page.draw();
}

/** Why something could not be read, and a button that tries again. */
function unread(page, reason, again) {
  return html`<p class="refused" role="alert">${reason}</p><p><button @click=${again}>${page.say("again")}</button></p>`;
}

// ------------------------------------------------------------------------------------------ one of them again

/** Asks for a recording's moments, and shows the one that a message brought about, or the first. */
export async function replay(page, name, message) {
  if (page.past?.name !== name || page.past.language !== page.language || page.past.refused) {
    const past = {name, language: page.language, moments: null, at: page.past?.at ?? 0, refused: ""};
    page.past = past;
    page.draw();
    const path = `runs/${encodeURIComponent(name)}/${past.language}.json`;
    try {
      past.moments = JSON.parse(await asked(page, path, {patience: READING_MS}));
    } catch (error) {
      past.refused = error.message;
    }
    if (page.past !== past) return; // something else was asked for meanwhile
  }
  const found = page.past.moments?.findIndex((moment) => moment.message === message) ?? -1;
  if (found >= 0) Object.assign(page.past, {at: found, playing: false});
  page.past.at = Math.min(page.past.at, Math.max(0, (page.past.moments?.length ?? 1) - 1));
  page.draw();
}

function replayed(page, past) {
  const back = html`<p><a href="#history">${page.say("back")}</a></p>`;
  if (past.refused) return html`${back}${unread(page, past.refused, () => replay(page, past.name))}`;
  if (!past.moments) return html`${back}<p class="quiet" role="status">${page.say("reading")}</p>`;
  const moment = past.moments[past.at];
  if (!moment) return html`${back}<p class="quiet">${page.say("nothing_told")}</p>`;
  const to = (at) => { past.at = at; page.draw(); };
  const shown = {...page, told: moment, photos: `runs/${encodeURIComponent(past.name)}/${past.language}`};
  return html`${back}<div class="scene">
    <div class="seen">${view(shown, moment.view)}
      <section class="player" aria-label=${page.say("replay")}>
        <button @click=${() => play(page, past)}>${page.say(past.playing ? "hold" : "play")}</button>
        <button ?disabled=${!past.at} @click=${() => to(past.at - 1)}>${page.say("before")}</button>
        <button ?disabled=${past.at + 1 >= past.moments.length} @click=${() => to(past.at + 1)}>${page.say("after")}</button>
        <input type="range" aria-label=${page.say("moment")} aria-valuetext="${lasted(moment.seconds)}: ${moment.doing.text}"
          min="0" max=${past.moments.length - 1} .value=${String(past.at)} @input=${(event) => to(Number(event.target.value))}>
        <span class="quiet">${lasted(moment.seconds)} / ${lasted(past.moments.at(-1).seconds)}</span>
      </section></div>
    <div class="said"><section class="doing" aria-labelledby="then"><h2 id="then">${page.say("then")}</h2>
      <p class="what">${moment.doing.text}</p>
      ${moment.doing.steps.length ? html`<ol class="steps">${moment.doing.steps.map((one, k) => html`<li
        class=${k + 1 < moment.doing.step ? "past" : ""} aria-current=${k + 1 === moment.doing.step ? "step" : nothing}
        >${one}</li>`)}</ol>` : nothing}
      ${question(page, moment.question && {...moment.question, answers: []})}
      ${notice(page, moment.notice, "")}
      ${engineers(page, moment.message, past.name)}
    </section></div>
    ${statements(page, moment)}
    ${solid(page, past, past.name)}
  </div>`;
}

/** Goes through the moments as they came, but waits for none of them long. */
function play(page, past) {
  past.playing = !past.playing;
  const step = () => {
    if (!past.playing || page.past !== past) return;
    const [now, next] = [past.moments[past.at], past.moments[past.at + 1]];
    past.playing = Boolean(next);
    if (next) setTimeout(() => { if (past.playing) { past.at += 1; page.draw(); step(); } },
      Math.min(LONGEST_MS, 1000 * (next.seconds - now.seconds)));
    page.draw();
  };
  if (past.at + 1 >= past.moments.length) past.at = 0;
  page.draw();
  step();
}
