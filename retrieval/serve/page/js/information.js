// What grasps tell, in bits. Objects that an answer does not list share what is left alike.

import { h } from "./dom.js";

const LEAST_BITS = 0.005;

/** What is believed now and what was before: pairs of probabilities, and how many objects share each. */
function beliefs({ results, none_probability: none, posterior }) {
  const { objects, none_prior: before } = posterior;
  const each = (1 - before) / objects;
  const unlisted = objects - results.length;
  const listed = results.reduce((sum, match) => sum + match.probability, 0);
  return [
    { now: none, was: before, shared: 1 },
    ...results.map((match) => ({ now: match.probability, was: each, shared: 1 })),
    { now: Math.max(0, 1 - none - listed), was: unlisted * each, shared: unlisted },
  ].filter(({ now, was }) => now > 0 && was > 0);
}

/** What an answer tells beyond what was believed before it: the Kullback-Leibler divergence of the two. */
export function toldBits(answer) {
  if (answer.none_probability === null || !answer.posterior) return 0; // nothing was felt
  return beliefs(answer).reduce((sum, { now, was }) => sum + now * Math.log2(now / was), 0);
}

/** What would name an object for certain. */
export const certainBits = ({ objects, none_prior: before }) => Math.log2(objects / (1 - before));

/** What is open: the entropy of what is believed. */
function openBits(answer) {
  return beliefs(answer).reduce((sum, { now, shared }) => sum - now * Math.log2(now / shared), 0);
}

/** So many grasps of one object weigh as much as this many that know nothing of each other. */
const worth = (grasps, dependence) => grasps / (1 + dependence * (grasps - 1));

/** What another grasp of the object may be expected to tell; a grasp that knows nothing of the others leaves 1 / e of
 * what is open (docs/service.md says how well that holds). */
export function anotherGrasp(answer) {
  const { grasps, dependence } = answer.posterior;
  const weighs = worth(grasps + 1, dependence);
  const open = openBits(answer);
  const bits = open * -Math.expm1(worth(grasps, dependence) - weighs);
  const expected =
    bits < LEAST_BITS
      ? "Another grasp would tell hardly anything"
      : `Another grasp would tell about ${bits.toFixed(2)} of the ${open.toFixed(1)} bits that are open`;
  return h(
    "section",
    { class: "another", "aria-label": "Another grasp" },
    h("h3", {}, "Another grasp?"),
    h(
      "p",
      { class: "turn" },
      `${expected}: to this model, ${grasps + 1} grasps of one object weigh as much as ${weighs.toFixed(2)} independent ones.`,
    ),
    h("p", { class: "faint" }, "Where it would tell most the matcher cannot say, as it sees a photo as a whole."),
  );
}
