// The scene as a graph: what is carried stands to the right of what carries it; dashed is what is next to each other.

import {nothing, svg} from "./lit-html.js";

const LETTER = 8, ROW = 34, BOX = 24, GAP = 44, BOW = 26; // pixels

export function graph(page, statements) {
  const told = statements.filter((one) => one.ties.some(carries));
  if (!told.length) return nothing;
  const ties = told.map((one) => one.ties.find(carries));
  const ground = ties.find((tie) => told.every((one) => one.about !== tie.other));
  if (!ground) return nothing;
  const boxes = placed(told, {about: ground.other, label: ground.label, surety: "sure", ties: []});
  const all = [...boxes.values()], last = Math.max(...all.map((box) => box.x + box.wide)), low = Math.max(...all.map((box) => box.y));
  return svg`<svg class="graph" viewBox="0 0 ${last + BOW} ${low + BOX}" style="max-width: ${last + BOW}px" role="img"
      aria-label=${page.say("graph")}>
    ${told.flatMap((one) => one.ties.map((tie) => edge(tie, boxes.get(one.about), boxes.get(tie.other))))}
    ${all.map(({one, x, y, wide}) => svg`<g class="${one.surety} ${page.marked === one.about ? "marked" : ""}">
      <rect x=${x} y=${y - BOX / 2} width=${wide} height=${BOX} rx="6"/>
      <text x=${x + wide / 2} y=${y}>${one.label}</text></g>`)}
  </svg>`;
}

function carries(tie) {
  return tie.kind === "carried";
}

/** A box for each thing: a column for each level, a row for each thing that carries nothing. */
function placed(told, ground) {
  const boxes = new Map(), levels = [];
  let row = 0;
  const place = (one, level) => {
    const carried = told.filter((other) => other.ties.find(carries).other === one.about);
    (levels[level] ??= []).push(one.about);
    boxes.set(one.about, {one, wide: LETTER * one.label.length + 16});
    const ys = carried.map((other) => place(other, level + 1));
    const y = ys.length ? (ys[0] + ys.at(-1)) / 2 : BOX / 2 + 1 + ROW * row++;
    boxes.get(one.about).y = y;
    return y;
  };
  place(ground, 0);
  let x = 1;
  for (const level of levels) {
    for (const name of level) boxes.get(name).x = x;
    x += Math.max(...level.map((name) => boxes.get(name).wide)) + GAP;
  }
  return boxes;
}

function edge(tie, from, to) {
  if (!from || !to) return nothing;
  if (carries(tie)) {
    const [x0, x1] = [to.x + to.wide, from.x], middle = (x0 + x1) / 2;
    return svg`<path d="M${x0} ${to.y}C${middle} ${to.y} ${middle} ${from.y} ${x1} ${from.y}"/>
      <text class="how" x=${x1 - 16} y=${from.y - 8}>${tie.how}</text>`;
  }
  const [x0, x1] = [from.x + from.wide, to.x + to.wide], far = Math.max(x0, x1) + BOW;
  return svg`<path class="beside" d="M${x0} ${from.y}C${far} ${from.y} ${far} ${to.y} ${x1} ${to.y}"><title>${tie.how}</title></path>`;
}
