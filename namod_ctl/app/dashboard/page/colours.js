// Colours that everybody can tell apart: cividis (Nunez, Anderton, Renslow 2018) by day, brightness of red by night.

import { isNight } from "./dom.js";

const CIVIDIS = [[0, 34, 78], [35, 62, 108], [87, 92, 109], [124, 123, 120], [165, 156, 116], [211, 193, 100], [254, 232, 56]];
const RED = [[16, 0, 0], [60, 6, 2], [110, 16, 8], [160, 30, 18], [210, 55, 40], [245, 95, 80], [255, 170, 155]];

export function rgb(share) {
  const scale = isNight() ? RED : CIVIDIS;
  const place = Math.min(Math.max(share, 0), 1) * (scale.length - 1);
  const low = Math.min(Math.floor(place), scale.length - 2);
  return scale[low].map((value, i) => Math.round(value + (scale[low + 1][i] - value) * (place - low)));
}

export const colour = (share) => `rgb(${rgb(share).join(" ")})`;

export function paintScale(canvas) {
  const context = canvas.getContext("2d");
  for (let x = 0; x < canvas.width; x += 1) {
    context.fillStyle = colour(x / (canvas.width - 1));
    context.fillRect(x, 0, 1, canvas.height);
  }
}

export function paintCells(canvas, rows) {
  const [height, width] = [rows.length, rows[0].length];
  canvas.width = width;
  canvas.height = height;
  const context = canvas.getContext("2d");
  const image = context.createImageData(width, height);
  rows.forEach((row, r) => row.forEach((value, c) => {
    image.data.set([...rgb(value / 255), 255], 4 * ((height - 1 - r) * width + c)); // rows run from -y to +y
  }));
  context.putImageData(image, 0, 0);
}
