// What is asked of the server: each question ends with an answer, or with words that say why there is none.

const PATIENCE_MS = 15_000;

/** The text of an answer. Throws an Error whose message can be shown, where it is a refusal or does not come in time. */
export async function asked(page, path, {patience = PATIENCE_MS, unanswered = "unanswered", ...options} = {}) {
  const [ok, text] = await fetch(path, {...options, signal: AbortSignal.timeout(patience)})
    .then(async (answer) => [answer.ok, await answer.text()])
    .catch(() => [false, page.say(unanswered)]);
  if (!ok) throw new Error(text);
  return text;
}
