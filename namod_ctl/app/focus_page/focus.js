// The star's size as it comes, for the person who turns the lens.

import { drawCurve } from "./curve.js";
import { byId, isNight, setNumbers, setText } from "./dom.js";
import { Picture } from "./picture.js";

const ARROWS = { better: "↓", worse: "↑", steady: "→" };
const PATIENCE_S = 4; // longer than that, and than two exposures, no frame should take
const HELD_S = 2; // a number that is replaced by a dash for a single frame cannot be read

const picture = new Picture(byId("star-image"), "star");
let shownS = 120;
let course = [];
let last = null;
let cameAt = 0;
let isConnected = false;

function about(told) {
  setText(byId("camera"), told.camera);
  document.title = `Focus: ${told.camera}`;
  shownS = told.shown_s;
  course = []; // all of it comes again
}

function news(told) {
  course = [...course, ...told.course].filter(([time]) => time >= told.at_s - shownS);
  last = told;
  cameAt = performance.now();
  const [perPx, unit] = told.arcmin_per_px === null ? [1, "pixel"] : [told.arcmin_per_px, "arcmin"];
  const [seenAt, sizePx] = course.findLast(([, size]) => size !== null) ?? [];
  const isSeen = told.at_s - seenAt < HELD_S;
  byId("size").classList.toggle("old", seenAt !== told.at_s);
  setText(byId("size"), isSeen ? digits(sizePx * perPx) : "–");
  setText(byId("units"), !isSeen ? "" : perPx === 1 ? unit : `${unit}, ${sizePx.toFixed(2)} pixel`);
  setText(byId("trend"), told.warning || told.trend === null ? "" : `${ARROWS[told.trend]} ${told.trend}`);
  setText(byId("warning"), told.warning);
  setText(byId("best"), told.best_px === null ? "–" : `${digits(told.best_px * perPx)} ${unit}`);
  setText(byId("above"), isSeen ? above(sizePx / told.best_px) : "");
  drawCurve(course, told.best_px, perPx, unit, shownS);
  showStar(told, perPx, unit);
  judgeAge();
}

function showStar(told, perPx, unit) {
  const numbers = [
    ["Exposure", told.exposure_s === null ? "no frame" : seconds(told.exposure_s)],
    ["Peak", told.peak_share === null ? "–" : `${Math.round(100 * told.peak_share)} %`],
  ];
  if (told.picture !== null) {
    picture.show({ run: 0, frames: { star: told.picture.number } });
    const width = told.picture.width_px;
    numbers.push(["Picture's width", perPx === 1 ? `${width} pixel` : `${digits(width * perPx)} ${unit}`]);
  }
  setNumbers(byId("numbers"), numbers);
}

// four figures at most, so that the number keeps its size
const digits = (value) => value.toFixed(value < 9.995 ? 2 : value < 99.95 ? 1 : 0);
const seconds = (value) => (value < 0.9995 ? `${(1000 * value).toPrecision(3)} ms` : `${value.toFixed(2)} s`);

function above(ratio) {
  return ratio < 1.02 ? "(this is it)" : `(now ${Math.round(100 * (ratio - 1))} % above)`;
}

function judgeAge() {
  const age = (performance.now() - cameAt) / 1000;
  if (!isConnected) showBanner("No connection to the focus command: what stands here is old. Trying again.");
  else if (last !== null && age > PATIENCE_S + 2 * (last.exposure_s ?? 0)) showBanner(`No frame for ${Math.round(age)} s: what stands here is old.`);
  else showBanner("");
}

function showBanner(text) {
  byId("banner").hidden = !text;
  setText(byId("banner"), text);
}

function listen() {
  const source = new EventSource("/events");
  source.addEventListener("about", (event) => about(JSON.parse(event.data)));
  source.addEventListener("news", (event) => news(JSON.parse(event.data)));
  source.onopen = () => { isConnected = true; cameAt = performance.now(); judgeAge(); };
  source.onerror = () => {
    isConnected = false;
    judgeAge();
    if (source.readyState === EventSource.CLOSED) setTimeout(listen, 2000);
  };
}

function setUpMode() {
  const button = byId("mode");
  const show = () => button.setAttribute("aria-pressed", String(isNight()));
  show();
  button.addEventListener("click", () => {
    document.documentElement.dataset.mode = isNight() ? "day" : "night";
    // the live page's cookie: who has chosen there need not choose here
    document.cookie = `namod-mode=${document.documentElement.dataset.mode}; max-age=31536000; path=/; samesite=strict`;
    show();
  });
}

setUpMode();
listen();
setInterval(judgeAge, 1000);
