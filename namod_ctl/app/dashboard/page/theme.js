// Before anything is painted: night or day, as chosen before, else as the device is set.
(() => {
  const chosen = /(?:^|; )namod-mode=(night|day)/.exec(document.cookie)?.[1];
  document.documentElement.dataset.mode = chosen ?? (matchMedia("(prefers-color-scheme: dark)").matches ? "night" : "day");
})();
