// Before anything is painted: night or day, as chosen before, else as the device is set.
(() => {
  let mode = null;
  try {
    mode = localStorage.getItem("namod-mode");
  } catch {
    // no storage: the device's setting has to do
  }
  if (mode !== "night" && mode !== "day") {
    mode = matchMedia("(prefers-color-scheme: dark)").matches ? "night" : "day";
  }
  document.documentElement.dataset.mode = mode;
})();
