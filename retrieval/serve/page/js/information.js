// What another grasp is expected to tell, as the service computed it.

import { h } from "./dom.js";

const LEAST_SHOWN_BITS = 0.005;

export function anotherGrasp({ posterior, information }) {
  const { next_grasp_bits: bits, remaining_bits: remaining, next_effective_grasps: effective } = information;
  const expected =
    bits < LEAST_SHOWN_BITS
      ? "Another grasp would tell hardly anything"
      : `Another grasp would tell about ${bits.toFixed(2)} of the ${remaining.toFixed(1)} bits that are open`;
  return h(
    "section",
    { class: "another", "aria-label": "Another grasp" },
    h("h3", {}, "Another grasp?"),
    h(
      "p",
      { class: "turn" },
      `${expected}: to this model, ${posterior.grasps + 1} grasps of one object weigh as much as ${effective.toFixed(2)} independent ones.`,
    ),
    h("p", { class: "faint" }, "The matcher cannot suggest where to grasp: it compares whole photos."),
  );
}
