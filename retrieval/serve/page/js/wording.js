// How numbers and verdicts are said.

/** A probability as people read it; number and sign stay on one line. */
export function percent(p) {
  if (p > 0.999) return "over 99.9\u00a0%";
  if (p < 0.001) return "under 0.1\u00a0%";
  return `${(100 * p).toFixed(1)}\u00a0%`;
}

/** "1 photo", "2,000 photos". */
export function count(number, word) {
  const more = word.endsWith("ch") ? "es" : "s";
  return `${number.toLocaleString("en")} ${word}${number === 1 ? "" : more}`;
}

/** A date and time of this place, from what the service writes. */
export function moment(text) {
  return new Date(text).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
}

/** A verdict in words: what stands above, the name or claim, and the sentence below. */
export function verdict(answer) {
  const best = answer.results[0];
  switch (answer.verdict) {
    case "match":
      return {
        above: "Most likely",
        claim: best.object_id,
        below: `Probability ${percent(best.probability)}. That it is none of these: ${percent(answer.none_probability)}.`,
      };
    case "none of these":
      return {
        above: "Most likely",
        claim: "None of these",
        below:
          `The catalogue lacks the object with probability ${percent(answer.none_probability)}. ` +
          ifPresent(best),
      };
    case "no contact":
      return {
        above: "Nothing was felt",
        claim: "No contact",
        below: "The gels look untouched, so nothing is named. Press the object and take the picture again.",
      };
    case "not a gel image":
      return {
        above: "Nothing is named",
        claim: "Not a gel image",
        below: "What is marked does not look like a gel that the model knows. Is it a photo of the object?",
      };
    default:
      return {
        above: "Nearest",
        claim: best.object_id,
        below: "This model was never calibrated: it ranks the objects and gives no probabilities.",
      };
  }
}

/** The first object given that the catalogue has it; answers that a history keeps from before do not say. */
function ifPresent(best) {
  if (best.probability_if_present == null) return "The nearest objects are shown.";
  return `If it has the object, this is ${best.object_id} with probability ${percent(best.probability_if_present)}.`;
}

/** How near a reference touch is, and what it did. */
export function nearness({ cosine, adds }) {
  const sign = adds < 0 ? "\u2212" : "+";
  const did = adds === null ? "no photo: found by touches alone" : `references add ${sign}${Math.abs(adds).toFixed(2)} to the logit`;
  return `cosine ${cosine.toFixed(2)}; ${did}`;
}

/** What was said of an answer, as a sentence. */
export function saidWords(said, objectId) {
  if (said === "right") return "Said to be right";
  if (said === "none") return "Said to be none of these";
  return `Said to be ${objectId}`;
}
