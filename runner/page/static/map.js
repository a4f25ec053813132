// Things seen from above, to be moved by mouse, finger or keys.

import {html, nothing, svg} from "./lit-html.js";
import {repeat} from "./lit-repeat.js";
import {keyOf} from "./parts.js";

const MM = 1000; // drawn in millimetres
const AROUND = 0.2; // metres about the things
const UNDER = 0.025; // metres from a thing to its name
const SHOWN_MS = 2000; // until something that was put down is shown where it is told to be, whatever has come of it
const NUDGE = 0.02; // metres a key moves something
const KEYS = {ArrowUp: [NUDGE, 0], ArrowDown: [-NUDGE, 0], ArrowLeft: [0, NUDGE], ArrowRight: [0, -NUDGE]};

let held = null; // what is being moved: {name, from, by}, metres; and the place it was told to have when it was put down

export function map(page, told) {
  const reason = page.refused[keyOf(told)];
  const points = told.places.flatMap((place) => place.points);
  const xs = points.map(([x]) => x), ys = points.map(([, y]) => y);
  const top = Math.max(...xs) + AROUND, left = Math.max(...ys) + AROUND;
  const wide = left - Math.min(...ys) + AROUND, tall = top - Math.min(...xs) + AROUND;
  return html`<section class="rearrange" aria-labelledby="map"><h2 id="map">${told.title}</h2>
    <svg class="map" viewBox="${-left * MM} ${-top * MM} ${wide * MM} ${tall * MM}" role="group" aria-labelledby="map" aria-describedby="map-hint">
      <path class="ground" d=${outline(told.ground)}></path>
      ${repeat(told.places, (place) => place.name, (place) => thing(page, told, place))}
    </svg>
    <p class="hint" id="map-hint">${told.hint}</p>
    ${reason ? html`<p class="refused" role="alert">${reason}</p>` : nothing}
  </section>`;
}

function thing(page, told, place) {
  if (held?.put && held.name === place.name && (held.put.x !== place.x || held.put.y !== place.y)) held = null;
  const [dx, dy] = held?.name === place.name ? held.by : [0, 0];
  const shown = svg`<path d=${outline(place.points)}></path>`;
  if (!place.movable) return svg`<g class="thing">${shown}</g>`;
  const moved = `translate(${-dy * MM} ${-dx * MM})`;
  const under = Math.min(...place.points.map(([x]) => x)) - UNDER;
  return svg`<g class="thing movable" transform=${moved} tabindex="0" role="button" aria-label=${place.label}
    @pointerdown=${(event) => hold(page, event, place)} @pointermove=${(event) => drag(page, event)}
    @pointerup=${() => drop(page, told, place)} @pointercancel=${() => release(page)}
    @keydown=${(event) => key(page, told, place, event)} @blur=${() => drop(page, told, place)}>
    ${shown}<text x=${-place.y * MM} y=${-under * MM} aria-hidden="true">${place.label}</text></g>`;
}

/** x upwards and y to the left. */
function outline(points) {
  return `M${points.map(([x, y]) => `${-y * MM} ${-x * MM}`).join("L")}Z`;
}

// ------------------------------------------------------------------------------------------ moving

function hold(page, event, {name}) {
  event.currentTarget.setPointerCapture(event.pointerId);
  held = {name, from: metres(event), by: [0, 0]};
  page.draw();
}

function drag(page, event) {
  if (!held?.from) return;
  const [x, y] = metres(event);
  held.by = [x - held.from[0], y - held.from[1]];
  page.draw();
}

function key(page, told, place, event) {
  const step = KEYS[event.key];
  if (event.key === "Enter") drop(page, told, place);
  if (!step) return;
  event.preventDefault();
  const [dx, dy] = held?.name === place.name ? held.by : [0, 0];
  held = {name: place.name, by: [dx + step[0], dy + step[1]]};
  page.draw();
}

/** Asks for the move; it stays there until it is told to be there, or refused. */
async function drop(page, told, place) {
  const [dx, dy] = held?.name === place.name && !held.put ? held.by : [0, 0];
  if (!dx && !dy) return;
  const {name, x, y} = place;
  const own = held = {...held, from: null, put: place};
  await page.call(told.stage, told.command, {name, x: (x + dx).toFixed(3), y: (y + dy).toFixed(3)});
  setTimeout(() => own === held && release(page), page.refused[keyOf(told)] ? 0 : SHOWN_MS);
}

function release(page) {
  held = null;
  page.draw();
}

/** Where a pointer is on the ground: x, y. */
function metres(event) {
  const shown = event.currentTarget.ownerSVGElement;
  const {x, y} = new DOMPoint(event.clientX, event.clientY).matrixTransform(shown.getScreenCTM().inverse());
  return [-y / MM, -x / MM];
}
