// The recordings beside the running one.

import {html, nothing} from "./lit-html.js";
import {lasted, size} from "./parts.js";

const WORDS = {COMPLETE: "complete", INCOMPLETE: "incomplete"};

export function history(page) {
  const runs = page.runs ?? [];
  const when = new Intl.DateTimeFormat(page.language, {dateStyle: "medium", timeStyle: "short"});
  return html`<section aria-labelledby="runs"><h2 id="runs">${page.say("runs")}</h2>
    <p class="quiet">${page.say("runs_hint")}</p>
    <ul class="runs">${runs.map((run) => html`<li>
      <b>${when.format(new Date(1000 * run.started))}</b>
      <span>${run.graph || run.name}</span>
      <span>${run.running ? page.say("running") : lasted(run.seconds)}</span>
      <span class="sure ${run.verdict === "COMPLETE" ? "sure" : run.running ? "unsure" : "doubtful"}">
        ${run.running ? page.say("being_written") : page.say(WORDS[run.verdict] ?? "torn")}</span>
      ${run.running ? nothing : html`<a href="runs/${run.name}.mcap" download
        >${page.say("download", {size: size(run.bytes)})}<span class="unseen"> ${run.name}</span></a>`}
    </li>`)}</ul></section>`;
}
