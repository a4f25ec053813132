// For the person who shows the scene: what is seen, what goes on, what can be done.

import {html, nothing, svg} from "./lit-html.js";
import {graph} from "./graph.js";
import {repeat} from "./lit-repeat.js";
import {map} from "./map.js";
import {buttons, engineers, lasted, solid} from "./parts.js";

const WIDE = 8, TALL = 21; // of the letters of a name, in pixels of a picture of 640
const BOW = 50; // by which an arrow rises, in the same pixels
const SIGNS = {sure: "✓", unsure: "?", doubtful: "!", unknown: "?"};

export function scene(page) {
  const told = page.told;
  if (!told) return html`<p class="quiet">${page.say("waiting")}</p>`;
  const offered = told.actions.filter((action) => action.kind !== "stop" && (action.now || !told.doing.busy));
  return html`<div class="scene">
    <div class="seen">${view(page, told.view)}</div>
    <div class="said">
      ${doing(page, told)}
      ${offered.length ? html`<section aria-labelledby="do"><h2 id="do">${page.say("do")}</h2>
        ${buttons(page, offered)}</section>` : nothing}
    </div>
    ${statements(page, told)}
    ${told.map ? map(page, told.map) : nothing}
    ${told.cards_title ? cards(page, told) : nothing}
    ${page.run ? solid(page, page, page.run.name) : nothing}
  </div>`;
}

export function view(page, view) {
  if (!view) return html`<div class="picture empty"><p>${page.say("nothing_seen")}</p></div>`;
  const [height, width] = view.photo.rgb;
  return html`<figure>
    <div class="picture" style="aspect-ratio: ${width} / ${height}">
      <img src="${page.photos ?? "photo"}/${view.photo.key}.jpg" width=${width} height=${height} alt=${view.caption}>
      <svg viewBox="0 0 ${width} ${height}" aria-hidden="true">
        ${view.outlines.map((one) => svg`<path class="${one.surety} ${marked(page, one)}"
          d="M${one.points.map((point) => point.join(" ")).join("L")}Z"/>`)}
        ${arrows(view.arrows, Math.max(1, page.told.doing.step))}
      </svg>
      ${labels(view.outlines).map(([one, x, y]) => html`<span
        class="name ${one.surety} ${marked(page, one)}"
        style="left: ${(100 * x) / width}%; top: ${(100 * y) / height}%"
        ><b aria-hidden="true">${SIGNS[one.surety]}</b> ${one.label}</span>`)}
    </div>
    <figcaption>${view.caption}</figcaption>
  </figure>`;
}

function marked(page, {name}) {
  return name === page.marked || name === page.told.question?.about ? "marked" : "";
}

/** What will be moved: bows from where things are to where they will be, and on each thing the number of its step. */
function arrows(found, first) {
  return [
    ...found.map(({start: [x0, y0], end: [x1, y1]}) => {
      const [x, y] = [(x0 + x1) / 2, Math.min(y0, y1) - BOW * (1 + Math.hypot(x1 - x0, y1 - y0) / 300)];
      const turn = (Math.atan2(y1 - y, x1 - x) * 180) / Math.PI;
      return svg`<g class="arrow"><path d="M${x0} ${y0}Q${x} ${y} ${x1} ${y1}"/>
        <path class="head" d="M0 0L-14 -7L-14 7Z" transform="translate(${x1} ${y1}) rotate(${turn})"/></g>`;
    }),
    ...found.map(({start: [x, y]}, k) => svg`<g class="step"><circle cx=${x} cy=${y} r="12"/>
      <text x=${x} y=${y}>${k + first}</text></g>`),
  ];
}

/** Where each name stands, its middle in pixels of the picture: over its outline, under it where other names are. */
function labels(outlines) {
  const placed = [];
  const free = ([, x, y, wide]) => placed.every((one) => 2 * Math.abs(x - one[1]) > wide + one[3] || Math.abs(y - one[2]) > TALL);
  for (const one of outlines.toReversed()) {
    const xs = one.points.map(([x]) => x), ys = one.points.map(([, y]) => y);
    const x = (Math.min(...xs) + Math.max(...xs)) / 2, wide = WIDE * (one.label.length + 3);
    const places = [Math.min(...ys) - TALL / 2, Math.max(...ys) + TALL / 2, Math.min(...ys) - 1.5 * TALL];
    const spots = places.map((y) => [one, x, Math.max(y, TALL / 2), wide]);
    placed.push(spots.find(free) ?? spots[0]);
  }
  return placed;
}

export function statements(page, told) {
  if (!told.statements.length) return nothing;
  const mark = (name) => () => { page.marked = name; page.draw(); };
  return html`<section class="there" aria-labelledby="there"><h2 id="there">${page.say("there")}</h2>
    <ul class="statements">${told.statements.map((one) => html`
      <li @mouseenter=${mark(one.about)} @mouseleave=${mark("")}>
        <span>${one.text}</span>
        ${one.how_sure ? html`<span class="sure ${one.surety}"><b aria-hidden="true">${SIGNS[one.surety]}</b>
          ${one.how_sure}</span>` : nothing}
      </li>`)}</ul>
    ${graph(page, told.statements)}</section>`;
}

function doing(page, told) {
  const {text, busy, step, steps, since_ns, expected_s} = told.doing;
  const past = Date.now() / 1000 - since_ns / 1e9, newest = page.calls.at(-1);
  return html`<section class="doing ${busy ? "busy" : ""}" aria-labelledby="now">
    <h2 id="now">${page.say("now")}</h2>
    <p class="what" role="status">${page.run?.state === "starting" ? page.say("starts") : text}</p>
    ${steps.length ? html`<progress max=${steps.length} value=${step - 1} aria-label=${page.say("progress")}></progress>
      <ol class="steps">${steps.map((one, k) => html`<li class=${k + 1 < step ? "past" : ""}
        aria-current=${k + 1 === step ? "step" : nothing}>${one}</li>`)}</ol>` : nothing}
    <p class="quiet">${[steps.length ? page.say("step", {step, steps: steps.length}) : "",
      busy && since_ns ? lasted(past) : "",
      expected_s > past ? page.say("left", {time: lasted(expected_s - past)}) : ""].filter(Boolean).join(" · ")}</p>
    ${question(page, told.question)}
    ${notice(page, told.notice)}
    ${page.calling.size || (newest && !newest.done && !busy) ? html`<p class="quiet" role="status">${page.say("passed_on")}</p>` : nothing}
    ${newest?.refused
      ? html`<p class="refused" role="alert">${page.say("refused")} ${newest.refused}</p>` : nothing}
  </section>`;
}

/** Asked of the person: what it is about is marked in the picture. */
export function question(page, question) {
  if (!question) return nothing;
  return html`<div class="question" role="alert"><p>${question.text}</p>
    <div class="answers">${buttons(page, question.answers)}</div></div>`;
}

export function notice(page, notice, run = page.run?.name) {
  if (!notice) return nothing;
  const [title, ...tried] = notice.tried;
  return html`<div class="notice ${notice.good ? "good" : "bad"}" role=${notice.good ? "status" : "alert"}>
    <p>${notice.text}</p>
    ${notice.help.length ? html`<ul>${notice.help.map((line) => html`<li>${line}</li>`)}</ul>` : nothing}
    ${title ? html`<p>${title}</p><ul>${tried.map((line) => html`<li>${line}</li>`)}</ul>` : nothing}
    ${notice.good || !notice.message || !run ? nothing : html`
      <p><a href="#history/${encodeURIComponent(run)}/${encodeURIComponent(notice.message)}">${page.say("see_moment")}</a></p>
      ${engineers(page, notice.message, run)}`}
  </div>`;
}

function cards(page, told) {
  return html`<section class="cards" aria-labelledby="cards"><h2 id="cards">${told.cards_title}</h2>
    ${told.cards.length ? nothing : html`<p class="quiet">${told.cards_hint}</p>`}
    <ul>${repeat(told.cards, (one) => one.key, (one) => card(page, one))}</ul>
    ${buttons(page, told.cards_actions)}</section>`;
}

/** To what the robot does now: there it goes on, for the keyboard too. */
function upwards() {
  const main = document.getElementById("main");
  main.scrollIntoView({behavior: "smooth"});
  main.focus({preventScroll: true});
}

function card(page, card) {
  return html`<li>
    ${card.photo ? html`<img src="photo/${card.photo.key}.jpg" alt=${card.title} loading="lazy">` : nothing}
    <h3>${card.title}</h3><p>${card.text}</p>
    <div @submit=${upwards}>
      ${buttons(page, card.actions)}</div>
    ${card.lines.length ? html`<details><summary>${card.lines_title}<span class="unseen"> ${card.title}</span></summary>
      <ul class="lines">${repeat(card.lines, (line) => line.key, (line, k) => html`<li><span id="line-${card.key}-${k}">${line.text}</span>
        <span class="small">${buttons(page, line.actions, {about: `line-${card.key}-${k}`})}</span>
      </li>`)}</ul></details>` : nothing}
    ${card.more.length || card.file ? html`<details><summary>${page.say("more")}<span class="unseen"> ${card.title}</span></summary>
      ${card.file ? html`<a class="button" href="file/${card.file.key}" download=${card.file.name}>${card.file.label}</a>` : nothing}
      ${buttons(page, card.more)}</details>` : nothing}
  </li>`;
}
