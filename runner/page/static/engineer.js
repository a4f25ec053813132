// For the engineer: processes, topics, commands as forms, and the log of any graph.

import {html, nothing} from "./lit-html.js";
import {keyOf, lasted, size} from "./parts.js";

export function engineer(page) {
  if (!page.status) return html`<p class="quiet">${page.say("waiting")}</p>`;
  return html`<div class="engineer">
    ${table(page, "processes", ["process", "state", "cpu", "memory", "queue", "steps", "restarts"],
      page.status.processes.map(process))}
    ${table(page, "topics", ["topic", "type", "sent", "rate", "bytes", "consumers"], topics(page.status))}
    <section aria-labelledby="commands"><h2 id="commands">${page.say("commands")}</h2>
      ${page.commands.length ? nothing : html`<p class="quiet">${page.say("no_commands")}</p>`}
      <div class="forms">${page.commands.map((command) => form(page, command))}</div></section>
    ${page.calls.length ? html`<section aria-labelledby="calls"><h2 id="calls">${page.say("calls")}</h2>
      <ol class="calls" reversed>${page.calls.toReversed().map((call) => called(page, call))}</ol></section>` : nothing}
    <section aria-labelledby="log"><h2 id="log">${page.say("log")}</h2>
      <div class="log" role="log" tabindex="0" aria-labelledby="log">${page.log.toReversed().map(line)}</div></section>
  </div>`;
}

function table(page, name, columns, rows) {
  return html`<section aria-labelledby=${name}><h2 id=${name}>${page.say(name)}</h2>
    <div class="wide" role="region" tabindex="0" aria-labelledby=${name}><table>
      <thead><tr>${columns.map((column) => html`<th scope="col">${page.say(column)}</th>`)}</tr></thead>
      <tbody>${rows.map(([first, ...rest]) => html`<tr><th scope="row">${first}</th>
        ${rest.map((cell) => html`<td>${cell}</td>`)}</tr>`)}</tbody>
    </table></div></section>`;
}

function process({name, state, cpu, pulse, steps_per_second, restarts, reason}) {
  const at = pulse?.handler ? `${state} ${lasted(pulse.busy_ns / 1e9)}: ${pulse.handler}` : state;
  const queued = pulse ? Object.values(pulse.queued).reduce((sum, one) => sum + one, 0) : "";
  return [name, at, pulse ? `${Math.round(100 * cpu)} %` : "", pulse ? size(pulse.memory_bytes) : "", queued,
    pulse ? steps_per_second.toFixed(1) : "", reason ? `${restarts}: ${reason}` : restarts];
}

function topics(status) {
  return status.topics.map(({topic, type, consumers}) => {
    const [stage, port] = topic.split("/");
    const flows = status.processes.filter((one) => one.stage === stage).map((one) => one.sent[port]).filter(Boolean);
    const sum = (key) => flows.reduce((all, flow) => all + flow[key], 0);
    return [topic, type, (status.published[topic] ?? 0) + sum("messages"), `${sum("per_second").toFixed(1)} /s`,
      `${size(sum("bytes_per_second"))}/s`, consumers.join(", ")];
  });
}

// ------------------------------------------------------------------------------------------ commands

/** A command as a form, made from the types of its fields. */
function form(page, {stage, name, text, fields}) {
  const key = keyOf({stage, command: name}), reason = page.refused[key], waits = () => page.calling.has(key);
  const send = (event) => {
    event.preventDefault();
    if (waits()) return;
    const filled = [...new FormData(event.target)].filter(([, value]) => value !== "");
    const ticked = fields.filter((field) => field.type === "bool" && !filled.some(([key]) => key === field.name));
    page.call(stage, name, Object.fromEntries([...filled, ...ticked.map((field) => [field.name, "false"])]));
  };
  return html`<form class="command" @submit=${send} aria-label="${stage} ${name}">
    <h3>${stage} <b>${name}</b></h3><p class="quiet">${text}</p>
    ${fields.map((field) => html`<label>${field.name} ${input(field)}
      ${field.text ? html`<span class="hint">${field.text}</span>` : nothing}</label>`)}
    <button ?disabled=${!page.ready} aria-disabled=${waits() ? "true" : nothing}>${page.say("call")}<span class="unseen"> ${stage} ${name}</span></button>
    ${reason ? html`<p class="refused" role="alert">${reason}</p>` : nothing}
  </form>`;
}

function input({name, type, default: given}) {
  if (type.includes(" | ")) {
    return html`<select name=${name}>${type.split(" | ").map((word) => html`<option
      ?selected=${given === `'${word}'`}>${word}</option>`)}</select>`;
  }
  if (type === "bool") return html`<input type="checkbox" name=${name} value="true" ?checked=${given === "True"}>`;
  const number = type === "int" || type === "float";
  return html`<input name=${name} type=${number ? "number" : "text"} step=${type === "float" ? "any" : nothing}
    ?required=${given === null} placeholder=${given?.replace(/^'(.*)'$/, "$1") || nothing} autocomplete="off">`;
}

function called(page, call) {
  const how = call.refused ? "doubtful" : call.done ? "sure" : "unsure";
  return html`<li><code>${call.id}</code>
    <span class="sure ${how}">${call.refused || page.say(call.done ? "done" : "under_way")}</span>
    ${call.lines.map(([level, text]) => html`<div class=${level}>${text}</div>`)}
    ${call.answer.length ? html`<details><summary>${page.say("answer")}</summary><pre>${call.answer.join("\n")}</pre></details>` : nothing}
  </li>`;
}

function line({stage, replica, level, text, time_ns}) {
  const at = new Date(time_ns / 1e6).toLocaleTimeString([], {hour12: false});
  return html`<div class=${level}><time>${at}</time> <b>${replica ? `${stage}.${replica}` : stage}</b> ${text}</div>`;
}
