// The page: what it is told over one connection, what it shows of that, and what it asks for.

import {asked} from "./asked.js";
import {engineer} from "./engineer.js";
import {history, listed, replay} from "./history.js";
import {html, nothing, render} from "./lit-html.js";
import {button, keyOf} from "./parts.js";
import {scene} from "./scene.js";

const LANGUAGES = {en: "English", de: "Deutsch"};
const VIEWS = {scene, history, engineer};
const AGAIN_MS = 1000; // until what was lost is tried again
const SILENT_MS = 15_000; // without a word, after which a connection counts as lost; the server says something every 5 s

const root = document.getElementById("page");

const page = {
  texts: {},
  language: "en",
  view: "scene",
  connected: false,
  met: false, // whether it has ever been connected
  told: null, // by whoever tells the story of this graph
  run: null,
  calls: [],
  calling: new Set(), // calls that nobody has taken yet, by key
  commands: [],
  status: null,
  log: [],
  runs: null, // recordings; null until they were asked for
  unread: "", // why they could not be listed
  past: null, // the recording that is told again: its name, its moments, the one that is shown
  solid: false, // whether the robot is shown in 3D
  fault: "", // why nothing new is told any more
  marked: "", // the outline that is pointed at
  refused: {}, // why the newest call was not possible, by key

  /** Whether there is somebody to ask. */
  get ready() {
    return page.connected && page.run?.state !== "starting";
  },

  /** The text of a key in the chosen language, its {words} filled in. */
  say(key, words = {}) {
    return (page.texts[key] ?? key).replace(/\{(\w+)\}/g, (_, word) => words[word] ?? "");
  },

  /** Calls a declared command of a stage, once its arguments are there; what is refused at once is shown where `key` is. */
  async call(stage, command, args, key = keyOf({stage, command})) {
    page.refused = {};
    page.calling.add(key);
    page.draw();
    try {
      const body = JSON.stringify({stage, command, arguments: await args});
      const headers = {"accept-language": page.language};
      await asked(page, "call", {method: "POST", body, headers, unanswered: "unknown_whether"});
    } catch (error) {
      page.refused[key] = error.message;
    }
    page.calling.delete(key);
    page.draw();
  },

  draw() {
    document.getElementById("shell")?.remove(); // what stands there until the page has its texts
    render(whole(), root);
  },
};

// ------------------------------------------------------------------------------------------ what it shows

function whole() {
  return html`
    <a class="skip" href="#main" @click=${skip}>${page.say("skip")}</a>
    <header>
      <h1>${page.say("title")}</h1>
      <nav aria-label=${page.say("views")}>${Object.keys(VIEWS).map(tab)}</nav>
      <label class="language"><span class="quiet">${page.say("language")}</span>
        <select .value=${page.language} @change=${(event) => choose(event.target.value)}>
          ${Object.entries(LANGUAGES).map(([key, name]) => html`<option value=${key} lang=${key}
            ?selected=${key === page.language}>${name}</option>`)}
        </select></label>
      ${stopButton()}
    </header>
    <main id="main" tabindex="-1">
      ${banner()}
      ${VIEWS[page.view](page)}
    </main>
    <footer>${page.run ? html`<a href="#history/${encodeURIComponent(page.run.name)}">${page.run.name}</a>` : nothing}</footer>`;
}

function tab(name) {
  return html`<a href="#${name}" aria-current=${name === page.view ? "page" : nothing}>${page.say(name)}</a>`;
}

function stopAction() {
  return page.told?.actions.find((action) => action.kind === "stop");
}

function stopButton() {
  const action = stopAction();
  return action ? button(page, action, {shortcut: "Escape"}) : nothing;
}

function banner() {
  if (!page.connected) return page.met ? html`<p class="banner bad" role="alert">${page.say("lost")}</p>` : nothing;
  if (page.fault) return html`<p class="banner bad" role="alert">${page.say("broken", {reason: page.fault})}</p>`;
  if (page.run?.state === "starting") {
    return html`<p class="banner" role="status">${page.say("starting", {waits: page.run.waits.join(", ")})}</p>`;
  }
  return nothing;
}

function skip(event) {
  event.preventDefault();
  document.getElementById("main").focus();
}

// ------------------------------------------------------------------------------------------ what it is told

let socket = null;

function connect() {
  const place = new URL("live", location.href);
  place.protocol = place.protocol.replace("http", "ws");
  const own = socket = new WebSocket(place);
  let silence = 0;
  const lose = () => {
    clearTimeout(silence);
    own.onopen = own.onmessage = own.onclose = null;
    own.close();
    page.connected = false;
    page.draw();
    setTimeout(connect, AGAIN_MS);
  };
  const wait = () => {
    clearTimeout(silence);
    silence = setTimeout(lose, SILENT_MS);
  };
  wait();
  own.onopen = () => {
    page.connected = page.met = true;
    page.refused = {};
    tell();
    page.draw();
  };
  own.onmessage = (event) => {
    wait();
    const {name, value} = JSON.parse(event.data);
    const [key, language] = name.split(" ");
    if (language && language !== page.language) return;
    page[key] = value;
    page.draw();
  };
  own.onclose = lose;
}

/** Says what this page shows, and so wants to be told. */
function tell() {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({view: page.view, language: page.language}));
}

let chosen = "";

async function choose(language) {
  chosen = language;
  const texts = await textsOf(language);
  if (chosen !== language) return; // another one was chosen meanwhile
  Object.assign(page, {language, texts});
  localStorage.setItem("language", language);
  document.documentElement.lang = language;
  document.title = page.say("title");
  tell();
  page.draw();
  if (page.past) await replay(page, page.past.name);
}

/** The texts of a language, asked for until they are there: before, there is nothing to say. */
async function textsOf(language) {
  for (;;) {
    try {
      return JSON.parse(await asked(page, `${language}.json`));
    } catch {
      await new Promise((again) => setTimeout(again, AGAIN_MS));
    }
  }
}

async function turn() {
  const [wanted, name, message] = location.hash.slice(1).split("/").map(decoded);
  page.view = wanted in VIEWS ? wanted : "scene";
  if (!name) page.past = null;
  tell();
  page.draw();
  if (name) {
    await replay(page, name, message);
  } else if (page.view === "history") {
    await listed(page);
  }
}

/** A part of an address as it was before it was encoded; what was not stays as it is. */
function decoded(part) {
  try {
    return decodeURIComponent(part);
  } catch {
    return part;
  }
}

addEventListener("hashchange", turn);
addEventListener("keydown", (event) => {
  const stop = stopAction();
  if (event.key === "Escape" && stop?.now) page.call(stop.stage, stop.command, stop.arguments, keyOf(stop));
});
setInterval(() => page.told?.doing.busy && page.draw(), 1000); // the time that has passed

const first = localStorage.getItem("language") ?? navigator.language.slice(0, 2);
await choose(first in LANGUAGES ? first : "en");
connect();
await turn();
