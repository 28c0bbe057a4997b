// The paths of the service. What it refuses becomes a Problem with its own sentence.

export class Problem extends Error {
  constructor(status, title, detail, again_s = null) {
    super(detail);
    Object.assign(this, { status, title, detail, again_s });
  }
}

let askToken = null;

/** What is called when the service wants its token; resolves when a session stands. */
export function onTokenWanted(ask) {
  askToken = ask;
}

async function reply(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, "The service does not answer", "It may have been stopped; start `retrieve serve` again.");
  }
  if (response.status === 401 && askToken && path !== "/v1/session") {
    await askToken();
    return reply(path, options);
  }
  if (response.ok) return response;
  const told = await response.json().catch(() => ({}));
  const again = Number(response.headers.get("retry-after")) || null;
  throw new Problem(response.status, told.title ?? `Status ${response.status}`, told.detail ?? "", again);
}

const json = async (path, options) => (await reply(path, options)).json();
const encodedPath = (id) => id.split("/").map(encodeURIComponent).join("/");
const posted = (body) => ({
  method: "POST",
  headers: { "content-type": "application/json" },
  body: JSON.stringify(body),
});

function withParameters(path, given) {
  const kept = Object.entries(given).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return kept.length ? `${path}?${new URLSearchParams(kept)}` : path;
}

/** The pictures of a query and its options, as a form. */
function form(touches, background, options) {
  const body = new FormData();
  touches.flat().forEach((blob, place) => body.append("gelsight", blob, blob.name ?? `touch-${place}.png`));
  background?.forEach((blob, place) => body.append("background", blob, blob.name ?? `background-${place}.png`));
  Object.entries(options).forEach(([name, value]) => value !== null && body.append(name, String(value)));
  return { method: "POST", body };
}

async function base64(blob) {
  const text = await new Promise((done, failed) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.onerror = () =>
      failed(new Problem(0, "A picture cannot be read", "Its file may have been moved; choose it again."));
    reader.readAsDataURL(blob);
  });
  return text.slice(text.indexOf(",") + 1);
}

function decoded(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Blob([bytes], { type: "image/png" });
}

export const photoURL = (id) => `/v1/photos/${encodedPath(id)}`;
export const thumbnailURL = (id, px = 480) => `/v1/thumbnails/${encodedPath(id)}?px=${px}`;
export const streamURL = (name, rate = 10) => `/v1/sensors/${encodeURIComponent(name)}/stream?rate=${rate}`;
export const EXPORT = "/v1/export.zip";

export const index = () => json("/v1/index");
export const session = (token) => reply("/v1/session", posted({ token }));
export const blob = async (path) => (await reply(path)).blob();
export const frame = (name) => blob(`/v1/sensors/${encodeURIComponent(name)}/frame`);

/** The answer to touches, and its name in the history where queries are kept. */
export async function query(touches, background, options) {
  const response = await reply("/v1/query", form(touches, background, options));
  return { answer: await response.json(), id: response.headers.get("x-query-id") };
}

export const growing = (touches, background, options) =>
  json("/v1/query/growing?alone=true", form(touches, background, options));

/** The simulated jaws close on an object, that one where it is named. */
export async function grasp(objectId = null) {
  const felt = await json(withParameters("/v1/grasp", { object: objectId }), { method: "POST" });
  return {
    objectId: felt.object_id,
    touches: felt.touches.map(decoded),
    background: felt.background?.map(decoded) ?? null,
  };
}

export async function agreement(photo, touches, background, squares = 8) {
  const all = await Promise.all(touches.map((grasp) => Promise.all(grasp.map(base64))));
  const untouched = background ? await Promise.all(background.map(base64)) : null;
  return json("/v1/agreement", posted({ photo, touches: all, background: untouched, squares }));
}

export const catalogue = (given, signal = null) => json(withParameters("/v1/catalogue", given), { signal });
export const nearest = (id, count = 12) => json(withParameters(`/v1/nearest/${encodedPath(id)}`, { count }));

export const history = (given) => json(withParameters("/v1/history", given));
export const entry = (id) => json(`/v1/history/${encodeURIComponent(id)}`);
/** The no-contact frames that a query was sent with; null where it had none. */
export const untouched = (id, letters) =>
  Promise.all(letters.map((letter) => blob(`/v1/history/${encodeURIComponent(id)}/touches/0/${letter}`))).catch(
    () => null,
  );
export const nearestTouches = (id, count = 8) =>
  json(withParameters(`/v1/history/${encodeURIComponent(id)}/nearest`, { count }));
export const feedback = (query, said, objectId = null) =>
  json("/v1/feedback", posted({ query, said, ...(objectId && { object_id: objectId }) }));

export const trials = () => json("/v1/trials");
export const beginTrials = (count, who) => json("/v1/trials", posted({ count, who }));
export const series = (id) => json(`/v1/trials/${encodeURIComponent(id)}`);
export const trial = (id, number) => json(`/v1/trials/${encodeURIComponent(id)}/${number}`);
export const choose = (id, number, choice) =>
  json(`/v1/trials/${encodeURIComponent(id)}/${number}`, posted({ choice }));
