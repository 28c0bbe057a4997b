// Live pictures of the browser's camera, or of the sensors of the service's rig.

import * as api from "./api.js";
import { h, problemCard } from "./dom.js";
import { finger } from "./tray.js";

const PAUSE_MS = 100; // between two pictures of a sensor

/** Buttons that open a source, the panel that shows it, and `stop`, which closes it. */
export function livePanel(index, tray) {
  const element = h("section", { class: "live", hidden: true, "aria-label": "Live pictures" });
  let release = () => {};

  function stop() {
    release();
    release = () => {};
    element.replaceChildren();
    element.hidden = true;
  }

  function open(title, content, tools) {
    const close = h("button", { type: "button", class: "link", onclick: stop }, "Close");
    element.replaceChildren(
      h("div", { class: "live-head" }, h("h2", {}, title), close),
      content,
      h("div", { class: "live-tools" }, tools),
    );
    element.hidden = false;
  }

  const buttons = [];
  if (index.sensors.length >= index.fingers) {
    buttons.push(
      h("button", { type: "button", class: "quiet", onclick: () => (stop(), openSensors()) }, "Live sensors"),
    );
  }
  if (navigator.mediaDevices?.getUserMedia) {
    buttons.push(h("button", { type: "button", class: "quiet", onclick: () => (stop(), openCamera()) }, "Camera"));
  }

  function openSensors() {
    const names = index.sensors;
    const chosen = names.slice(0, index.fingers);
    const images = chosen.map((name) => h("img", { alt: `Live picture of sensor ${name}` }));
    const figures = chosen.map((name, place) => {
      const choose = h(
        "select",
        { "aria-label": `Sensor of finger ${finger(place)}` },
        names.map((each) => h("option", { value: each, selected: each === name }, `Sensor ${each}`)),
      );
      choose.addEventListener("change", () => (chosen[place] = choose.value));
      return h(
        "figure",
        { class: "slot" },
        images[place],
        h("figcaption", {}, names.length > index.fingers ? choose : `Sensor ${name}`),
      );
    });
    let isOpen = true;
    release = () => (isOpen = false);
    images.forEach(async (image, place) => {
      while (isOpen) {
        const before = image.src;
        try {
          image.src = URL.createObjectURL(await api.frame(chosen[place]));
          if (before) URL.revokeObjectURL(before);
        } catch {
          // the next picture may arrive
        }
        await new Promise((done) => setTimeout(done, PAUSE_MS));
      }
    });
    const frames = (onFrames) => async (event) => {
      const button = event.currentTarget;
      button.disabled = true;
      try {
        onFrames(await Promise.all(chosen.map(api.frame)));
      } catch (error) {
        button.after(problemCard(error));
      }
      button.disabled = false;
    };
    open("Live sensors", h("div", { class: "fingers" }, figures), [
      h(
        "button",
        { type: "button", class: "primary", onclick: frames((pictures) => tray.addGrasp(pictures)) },
        "Take this touch",
      ),
      h(
        "button",
        {
          type: "button",
          class: "link",
          onclick: frames((pictures) => pictures.forEach((blob, place) => tray.putBackground(place, blob))),
        },
        "Take as no-contact frames",
      ),
    ]);
  }

  async function openCamera(deviceId = null) {
    const video = h("video", { autoplay: true, muted: true, playsInline: true, "aria-label": "The camera's picture" });
    let stream;
    try {
      stream = await navigator.mediaDevices.getUserMedia({
        video: deviceId ? { deviceId: { exact: deviceId } } : true,
      });
    } catch (error) {
      const detail =
        error.name === "NotAllowedError"
          ? "Allow this page to use the camera in the browser's settings."
          : "No camera is connected, or another program uses it.";
      open(
        "Camera",
        problemCard({ title: "The camera cannot be used", detail }, () => openCamera(deviceId)),
        [],
      );
      return;
    }
    release = () => stream.getTracks().forEach((track) => track.stop());
    video.srcObject = stream;
    const cameras = (await navigator.mediaDevices.enumerateDevices()).filter((device) => device.kind === "videoinput");
    const current = stream.getVideoTracks()[0].getSettings().deviceId;
    const choose = h(
      "select",
      { "aria-label": "Which camera" },
      cameras.map((each, place) =>
        h("option", { value: each.deviceId, selected: each.deviceId === current }, each.label || `Camera ${place + 1}`),
      ),
    );
    choose.addEventListener("change", () => (stop(), openCamera(choose.value)));
    const take = h("button", { type: "button", class: "primary" });
    const updateLabel = () =>
      (take.textContent = index.fingers > 1 ? `Take finger ${finger(nextPlace(tray))}` : "Take this touch");
    take.addEventListener("click", async () => {
      const blob = await still(video);
      if (nextPlace(tray) === 0) tray.addGrasp([blob]);
      else tray.put(tray.grasps.length - 1, nextPlace(tray), blob);
      updateLabel();
    });
    updateLabel();
    open("Camera", h("div", {}, video, cameras.length > 1 && choose), [take]);
  }

  return { element, buttons, stop };
}

/** The finger whose picture is missing in the last grasp; 0 begins a new grasp. */
function nextPlace(tray) {
  return Math.max(0, tray.grasps.at(-1)?.indexOf(null) ?? 0);
}

/** The current picture of a video, as a PNG file. */
async function still(video) {
  if (!video.videoWidth) await new Promise((done) => video.addEventListener("loadeddata", done, { once: true }));
  const canvas = h("canvas", { width: video.videoWidth, height: video.videoHeight });
  canvas.getContext("2d").drawImage(video, 0, 0);
  return new Promise((done) => canvas.toBlob(done, "image/png"));
}
