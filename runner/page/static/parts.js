// What several views show alike.

import {html, nothing} from "./lit-html.js";
import {repeat} from "./lit-repeat.js";

const MOST_BYTES = 10_000_000; // of a file; what can be imported is not larger

/** What an action and its calls are known by: what is asked of whom, and which field a person fills in. */
export function keyOf({stage, command, arguments: args = {}, ask}) {
  return `${stage}.${command} ${JSON.stringify(args)} ${ask?.label ?? ""}`;
}

/** Buttons for actions: each stays the same one, with its focus, whatever comes and goes beside it. */
export function buttons(page, actions, options) {
  return repeat(actions, keyOf, (one) => button(page, one, options));
}

/** A button for an action; where it asks for something, a small form. Beside it stands why it was refused. Until it is
 * answered it takes no second press, but for a stop, which can always be tried. */
export function button(page, action, {shortcut, about} = {}) {
  const key = keyOf(action), stops = action.kind === "stop";
  const reason = page.refused[key], waits = () => page.calling.has(key) && !stops;
  const kind = action.kind === "plain" ? "" : action.kind;
  const send = (event) => {
    event.preventDefault();
    if (waits() || (action.confirm && !confirm(action.confirm))) return;
    page.call(action.stage, action.command, filled(page, action, new FormData(event.target)), key);
    event.target.reset();
  };
  return html`<form class="action ${kind}" @submit=${send}>
    ${action.ask ? field(action, about) : nothing}
    <button class=${kind} ?disabled=${!action.now || !(page.ready || stops)} aria-disabled=${waits() ? "true" : nothing}
      aria-keyshortcuts=${shortcut ?? nothing} aria-describedby=${about ?? nothing} title=${shortcut ? page.say("shortcut", {key: shortcut}) : nothing}
      >${action.label}</button>
    ${reason ? html`<p class="refused" role="alert">${page.say("refused")} ${reason}</p>` : nothing}
  </form>`;
}

/** The arguments of an action with what was typed, or the content of a file as base64. */
async function filled(page, {ask, arguments: args}, form) {
  const value = form.get("asked");
  if (!ask || !(value instanceof File)) return ask ? {...args, [ask.field]: value} : args;
  if (value.size > MOST_BYTES) throw new Error(page.say("too_large", {size: size(value.size), most: size(MOST_BYTES)}));
  const bytes = new Uint8Array(await value.arrayBuffer());
  return {...args, [ask.field]: btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""))};
}

function field({ask, command}, about) {
  const hint = `${command}-hint`;
  if (ask.kind === "choice") return html`<label>${ask.label}
      <select name="asked" aria-describedby=${about ?? nothing}>${ask.choices.map(([value, text]) => html`
        <option value=${value} ?selected=${value === ask.chosen}>${text}</option>`)}</select></label>`;
  return html`<label>${ask.label}
      <input name="asked" type=${ask.kind} required autocomplete="off" maxlength="60" pattern=${ask.pattern || nothing}
        title=${ask.hint || nothing} aria-describedby=${ask.hint ? hint : nothing}></label>
    ${ask.hint ? html`<p class="hint" id=${hint}>${ask.hint}</p>` : nothing}`;
}

/** What an engineer types to see where a message comes from, and what there was to see then. */
export function engineers(page, message, run) {
  return html`<p class="quiet">${page.say("ask_engineer")} <code>runner why ${message} ${run}.mcap</code>,
    <code>runner view ${run}.mcap --at ${message}</code></p>`;
}

/** A duration as people say it: 8 s, 1 min 5 s. */
export function lasted(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  return whole < 60 ? `${whole} s` : `${Math.floor(whole / 60)} min ${whole % 60} s`;
}

/** A number of bytes: 15.5 MB. */
export function size(bytes) {
  const power = Math.min(3, Math.max(0, Math.floor(Math.log10(Math.max(1, bytes)) / 3)));
  return `${(bytes / 1000 ** power).toFixed(power ? 1 : 0)} ${["B", "kB", "MB", "GB"][power]}`;
}

/** The robot and what it sees in 3D, in Rerun's viewer: large, so only once it is wanted, which `holder.solid` says. */
export function solid(page, holder, recording) {
  const wanted = () => { holder.solid = !holder.solid; page.draw(); };
  const drawing = new URL(`runs/${encodeURIComponent(recording)}.rrd`, location.href).href.split("#")[0];
  return html`<section class="solid" aria-label=${page.say("solid")}>
    <button aria-expanded=${holder.solid ? "true" : "false"} @click=${wanted}>${page.say("solid")}</button>
    ${holder.solid ? html`<p class="quiet">${page.say("solid_hint")}</p><iframe title=${page.say("solid")}
      src="viewer/index.html?hide_welcome_screen&persist=0&url=${encodeURIComponent(drawing)}"></iframe>` : nothing}
  </section>`;
}
