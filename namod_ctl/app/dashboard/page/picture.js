// One camera's last kept frame. A new one is fetched when the one before has come, and not more often than eyes need.

const EVERY_MS = 700;

export class Picture {
  constructor(image, camera, onShown = () => {}) {
    this.image = image;
    this.camera = camera;
    this.isKept = false;
    this.wanted = "";
    this.begun = -Infinity;
    this.timer = 0;
    this.isBusy = false;
    this.onShown = onShown;
  }

  show(now, mark = null) { // `mark` belongs to this frame: it is handed back when the frame is to be seen
    const index = now.frames[this.camera];
    this.isKept = index !== undefined;
    if (!this.isKept) {
      this.image.hidden = true;
      return;
    }
    this.mark = mark;
    this.wanted = `/frame/${now.run}/${this.camera}/${index}`;
    this.fetch();
  }

  fetch() {
    if (this.isBusy || this.timer || this.wanted === this.fetched) return;
    const wait = this.begun + EVERY_MS - performance.now();
    if (wait > 0) {
      this.timer = setTimeout(() => { this.timer = 0; this.fetch(); }, wait);
      return;
    }
    this.isBusy = true;
    this.begun = performance.now();
    [this.fetched, this.markFetched] = [this.wanted, this.mark];
    // beside the one that is shown, which stays when the frame has gone meanwhile: the recorder keeps its newest only
    const next = Object.assign(new Image(), { id: this.image.id, alt: this.image.alt, className: this.image.className });
    next.addEventListener("load", () => { this.take(next); this.done(); });
    next.addEventListener("error", () => this.done());
    next.src = this.wanted;
  }

  take(next) {
    next.hidden = !this.isKept;
    this.image.replaceWith(next);
    this.image = next;
    this.onShown(this.markFetched);
  }

  done() {
    this.isBusy = false;
    this.fetch();
  }
}
