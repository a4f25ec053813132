// The page: what it is told over one connection, what it shows of that, and what it asks for.

import {html, nothing, render} from "./lit-html.js";
import {engineer} from "./engineer.js";
import {history, replay} from "./history.js";
import {button} from "./parts.js";
import {scene} from "./scene.js";

const LANGUAGES = {en: "English", de: "Deutsch"};
const VIEWS = {scene, history, engineer};
const AGAIN_MS = 1000; // until a connection that was lost is tried again

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
  calling: 0, // calls that nobody has taken yet
  commands: [],
  status: null,
  log: [],
  runs: null, // recordings; null until they were asked for
  past: null, // the recording that is told again: its name, its moments, the one that is shown
  solid: false, // whether the robot is shown in 3D
  marked: "", // the outline that is pointed at
  refused: {}, // why a command could not be called, by stage.command

  /** Whether there is somebody to ask. */
  get ready() {
    return page.connected && page.run?.state !== "starting";
  },

  /** The text of a key in the chosen language, its {words} filled in. */
  say(key, words = {}) {
    return (page.texts[key] ?? key).replace(/\{(\w+)\}/g, (_, word) => words[word] ?? "");
  },

  /** Calls a declared command of a stage; what is refused at once is shown beside it. */
  async call(stage, command, args) {
    const name = `${stage}.${command}`;
    delete page.refused[name];
    page.calling += 1;
    page.draw();
    try {
      const body = JSON.stringify({stage, command, arguments: args});
      const answer = await fetch("call", {method: "POST", body, headers: {"accept-language": page.language}});
      if (!answer.ok) page.refused[name] = await answer.text();
    } catch {
      page.refused[name] = page.say("lost");
    }
    page.calling -= 1;
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
    <footer>${page.run ? html`<a href="#history/${page.run.name}">${page.run.name}</a>` : nothing}</footer>`;
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
  socket = new WebSocket(place);
  socket.onopen = () => {
    page.connected = page.met = true;
    tell();
    page.draw();
  };
  socket.onmessage = (event) => {
    const {name, value} = JSON.parse(event.data);
    const [key, language] = name.split(" ");
    if (language && language !== page.language) return;
    page[key] = value;
    page.draw();
  };
  socket.onclose = () => {
    page.connected = false;
    page.draw();
    setTimeout(connect, AGAIN_MS);
  };
}

/** Says what this page shows, and so wants to be told. */
function tell() {
  if (socket?.readyState === WebSocket.OPEN) socket.send(JSON.stringify({view: page.view, language: page.language}));
}

async function choose(language) {
  page.language = language;
  localStorage.setItem("language", language);
  document.documentElement.lang = language;
  page.texts = await (await fetch(`${language}.json`)).json();
  document.title = page.say("title");
  tell();
  page.draw();
  if (page.past) await replay(page, page.past.name);
}

async function turn() {
  const [wanted, name, message] = decodeURIComponent(location.hash.slice(1)).split("/");
  page.view = wanted in VIEWS ? wanted : "scene";
  if (!name) page.past = null;
  tell();
  page.draw();
  if (name) {
    await replay(page, name, message);
  } else if (page.view === "history") {
    page.runs = await (await fetch("runs")).json();
    page.draw();
  }
}

addEventListener("hashchange", turn);
addEventListener("keydown", (event) => {
  const stop = stopAction();
  if (event.key === "Escape" && stop?.now) page.call(stop.stage, stop.command, stop.arguments);
});
setInterval(() => page.told?.doing.busy && page.draw(), 1000); // the time that has passed

const first = localStorage.getItem("language") ?? navigator.language.slice(0, 2);
await choose(first in LANGUAGES ? first : "en");
connect();
await turn();
