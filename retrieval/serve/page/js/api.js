// The routes of the service. A refused request becomes an HttpProblem with the detail of the service.

export class HttpProblem extends Error {
  constructor(status, title, detail, again_s = null) {
    super(detail);
    Object.assign(this, { status, title, detail, again_s });
  }
}

let requestToken = null;

/** Set the function that is called when the service requires its token; it resolves when a session exists. */
export function onTokenRequired(request) {
  requestToken = request;
}

async function reply(path, options) {
  let response;
  try {
    response = await fetch(path, options);
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new HttpProblem(0, "The service does not answer", "It may have stopped. Start `retrieve serve` again.");
  }
  if (response.status === 401 && requestToken && path !== "v1/session") {
    await requestToken();
    return reply(path, options);
  }
  if (response.ok) return response;
  const document = await response.json().catch(() => ({}));
  const again = Number(response.headers.get("retry-after")) || null;
  throw new HttpProblem(response.status, document.title ?? `Status ${response.status}`, document.detail ?? "", again);
}

const json = async (path, options) => (await reply(path, options)).json();

/** An item of the history, from `address`; its paths, which are relative to that address, become whole addresses. */
const withAddresses = (item, address) => ({
  ...item,
  touches: item.touches.map((grasp) => grasp.map((path) => new URL(path, address).href)),
});
const encodedPath = (id) => id.split("/").map(encodeURIComponent).join("/");
const jsonPost = (body) => ({
  method: "POST",
  headers: { "content-type": "application/json" },
  body: JSON.stringify(body),
});

function withParameters(path, parameters) {
  const present = Object.entries(parameters).filter(([, value]) => value !== null && value !== undefined && value !== "");
  return present.length ? `${path}?${new URLSearchParams(present)}` : path;
}

async function base64(blob) {
  const text = await new Promise((done, failed) => {
    const reader = new FileReader();
    reader.onload = () => done(reader.result);
    reader.onerror = () =>
      failed(new HttpProblem(0, "A picture cannot be read", "Its file may have moved. Choose it again."));
    reader.readAsDataURL(blob);
  });
  return text.slice(text.indexOf(",") + 1);
}

function decoded(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  return new Blob([bytes], { type: "image/png" });
}

export const photoURL = (id) => `v1/photos/${encodedPath(id)}`;
export const thumbnailURL = (id, px = 480) => `${photoURL(id)}?px=${px}`;

export const index = () => json("v1/index");
export const session = (token) => reply("v1/session", jsonPost({ token }));
export const blob = async (path) => (await reply(path)).blob();
export const frame = (name) => blob(`v1/sensors/${encodeURIComponent(name)}/frame`);

/** The answer to touches, and its id in the history, null if no history is stored. */
export async function query(touches, background, openings, options) {
  const response = await reply("v1/query", await touchesPost(touches, background, { opening_mm: openings, ...options }));
  return { answer: await response.json(), id: response.headers.get("x-query-id") };
}

/** Grasp an object with the simulated rig: the named one, else a random one. */
export async function grasp(objectId = null) {
  const result = await json(withParameters("v1/grasp", { object: objectId }), { method: "POST" });
  return {
    objectId: result.object_id,
    touches: result.touches.map(decoded),
    background: result.background?.map(decoded) ?? null,
    opening_mm: result.opening_mm,
  };
}

/** The request with gel images and other values as one JSON body. */
async function touchesPost(touches, background, values) {
  const all = await Promise.all(touches.map((grasp) => Promise.all(grasp.map(base64))));
  const frames = background ? await Promise.all(background.map(base64)) : null;
  return jsonPost({ touches: all, background: frames, ...values });
}

export const verify = async (expect, touches, background, far) =>
  json("v1/verify", await touchesPost(touches, background, { expect, far }));

const enrolled = (objectId) => `v1/objects/${encodedPath(objectId)}/touches`;
/** Remember touches of an object. */
export const enrol = async (objectId, touches, background, opening_mm) =>
  json(enrolled(objectId), await touchesPost(touches, background, { opening_mm }));
/** Forget the touches that `enrol` added. */
export const forget = (objectId, added) =>
  json(`${enrolled(objectId)}?${new URLSearchParams(added.map((id) => ["touch", id]))}`, { method: "DELETE" });

export const catalogue = (parameters, signal = null) => json(withParameters("v1/catalogue", parameters), { signal });

export async function history(parameters) {
  const response = await reply(withParameters("v1/history", parameters));
  const page = await response.json();
  return { ...page, items: page.items.map((item) => withAddresses(item, response.url)) };
}
export async function entry(id) {
  const response = await reply(`v1/history/${encodeURIComponent(id)}`);
  return withAddresses(await response.json(), response.url);
}
/** The no-contact frames of a query; null if it has none. */
export const noContactFrames = (id, letters) =>
  Promise.all(letters.map((letter) => blob(`v1/history/${encodeURIComponent(id)}/touches/0/${letter}`))).catch(
    () => null,
  );
export const feedback = (query, value, objectId = null) =>
  json("v1/feedback", jsonPost({ query, feedback: value, ...(objectId && { object_id: objectId }) }));
