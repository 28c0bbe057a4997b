// Texts of numbers, verdicts and feedback.

/** A probability in percent; number and sign stay on one line. */
export function percent(p) {
  if (p > 0.999) return "over 99.9\u00a0%";
  if (p < 0.001) return "under 0.1\u00a0%";
  return `${(100 * p).toFixed(1)}\u00a0%`;
}

/** "1 photo", "2,000 photos". */
export function count(number, word) {
  const plural = word.endsWith("y") ? `${word.slice(0, -1)}ies` : word.endsWith("ch") ? `${word}es` : `${word}s`;
  return `${number.toLocaleString("en")} ${number === 1 ? word : plural}`;
}

/** The local date and time of a timestamp. */
export function moment(text) {
  return new Date(text).toLocaleString("en-GB", { dateStyle: "medium", timeStyle: "short" });
}

/** The texts of a verdict: a line above, the name or claim, and a sentence below. */
export function verdict(answer) {
  const best = answer.results[0];
  switch (answer.verdict) {
    case "match":
      return {
        above: "Most likely",
        claim: best.object_id,
        below: `Probability ${percent(best.probability)}. None of these: ${percent(answer.none_probability)}.`,
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
        above: "No object is named",
        claim: "No contact",
        below: "The gel images show no contact. Press the object and take the pictures again.",
      };
    case "not a gel image":
      return {
        above: "No object is named",
        claim: "Not a gel image",
        below: "The marked images do not look like the gel images that the model was trained on. Are they photos?",
      };
    default:
      return {
        above: "Best match",
        claim: best.object_id,
        below: "This model is not calibrated: it ranks the objects, but gives no probabilities.",
      };
  }
}

/** A log likelihood ratio with one decimal. */
export function logRatio(value) {
  return value.toFixed(1).replace(/^-0\.0$/, "0.0").replace("-", "\u2212");
}

/** The same texts of a verification. */
export function verificationVerdict({ decision, expected, bounds, log_ratios: ratios }) {
  const above = `Is it ${expected}?`;
  if (!bounds) return { ...verdict({ verdict: decision, results: [] }), above };
  const [last, largest] = [ratios.at(-1), Math.max(...ratios)].map(logRatio);
  const [accept, reject] = [bounds.accept, bounds.reject].map(logRatio);
  const range = ({ value, low, high }) => `${percent(value)} (95\u00a0% interval: ${percent(low)} to ${percent(high)})`;
  switch (decision) {
    case "accept":
      return {
        above,
        claim: "Accept",
        below:
          `The largest log likelihood ratio, ${largest}, reaches ${accept}. ` +
          `False-accept rate: ${range(bounds.false_accepts)}.`,
      };
    case "reject":
      return {
        above,
        claim: "Reject",
        below:
          `The log likelihood ratio is ${last}; ${accept} is needed. ` +
          `False-reject rate: ${range(bounds.false_rejects)}.`,
      };
    default:
      return {
        above,
        claim: "Another grasp needed",
        below:
          `The log likelihood ratio, ${last}, lies between ${reject} (reject) and ${accept} (accept). ` +
          "Add a grasp at another place.",
      };
  }
}

/** A sentence on the first object given that the catalogue contains it. */
function ifPresent(best) {
  return `If it contains the object, this is ${best.object_id} with probability ${percent(best.probability_if_present)}.`;
}

/** The cosine of a reference touch, and its effect on the logit. */
export function nearness({ cosine, adds }) {
  const sign = adds < 0 ? "\u2212" : "+";
  const effect = adds === null ? "no photo: scored by its touches only" : `references add ${sign}${Math.abs(adds).toFixed(2)} to the logit`;
  return `cosine ${cosine.toFixed(2)}; ${effect}`;
}

/** The feedback on an answer, as text. */
export function feedbackText(feedback, objectId) {
  if (feedback === "right") return "Feedback: right";
  if (feedback === "none") return "Feedback: not in the catalogue";
  return `Feedback: ${objectId}`;
}
