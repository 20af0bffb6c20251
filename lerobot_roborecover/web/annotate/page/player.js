// Shows one episode's frames: where one is, stepping and playing.

const $ = (id) => document.getElementById(id);
const SPEEDS = [0.25, 0.5, 1, 2, 4];

export class Player {
  // session: {cameras, fps}. drew(step): a frame is shown. failed(text): it cannot be.
  constructor(session, { drew, failed }) {
    Object.assign(this, { session, drew, failed, frames: null, last: 0, frame: 0, shown: -1, playing: 0, speed: 2 });
    this.faster(0);
  }

  // frames: of the episode from now on; the frame before is shown until the first one is there.
  open(frames, frame) {
    this.pause();
    if (this.frames !== frames) this.frames?.stop();
    Object.assign(this, { frames, last: frames.steps - 1, frame, shown: -1 });
    $("frame").textContent = `… / ${this.last}`;
  }

  async show(step) {
    const own = this.frames;
    step = Math.min(Math.max(step, 0), this.last);
    const direction = step < this.frame ? -1 : 1;
    this.frame = step;
    let bitmaps = own.now(step);
    if (!bitmaps) {
      try {
        bitmaps = await own.at(step);
      } catch (error) {
        if (own === this.frames) this.failed(`frame ${step}: ${error.message}`);
        return;
      }
      // Meanwhile one may have gone on, or elsewhere.
      if (own !== this.frames || this.frame !== step) return;
    }
    this.session.cameras.forEach((camera, i) => {
      const canvas = $("cameras").children[i].firstChild;
      if (canvas.width !== bitmaps[i].width) canvas.width = bitmaps[i].width;
      if (canvas.height !== bitmaps[i].height) canvas.height = bitmaps[i].height;
      canvas.getContext("2d").drawImage(bitmaps[i], 0, 0);
      canvas.dataset.step = step;
      canvas.dataset.episode = own.id;
    });
    this.shown = step;
    $("frame").textContent = `${step} / ${this.last}`;
    $("time").textContent = `${(step / this.session.fps).toFixed(2)} s`;
    this.drew(step);
    document.dispatchEvent(new CustomEvent("frameshown", { detail: step }));
    own.look(step, direction);
  }

  go(step) {
    this.pause();
    this.show(step);
  }

  move(by) {
    this.go(this.frame + by);
  }

  play() {
    if (this.playing) return this.pause();
    if (this.frame >= this.last) this.show(0);
    let before = performance.now(), owed = 0;
    const tick = (now) => {
      owed += ((now - before) / 1000) * this.session.fps * SPEEDS[this.speed];
      before = now;
      // A frame that has not arrived yet is waited for, never skipped over unseen at normal speed.
      while (owed >= 1 && this.shown === this.frame && this.frame < this.last) {
        owed -= 1;
        this.show(this.frame + 1);
      }
      owed = Math.min(owed, 8);
      if (this.frame >= this.last) return this.pause();
      this.playing = requestAnimationFrame(tick);
    };
    this.playing = requestAnimationFrame(tick);
    $("play").classList.add("on");
  }

  pause() {
    cancelAnimationFrame(this.playing);
    this.playing = 0;
    $("play").classList.remove("on");
  }

  faster(by) {
    this.speed = Math.min(Math.max(this.speed + by, 0), SPEEDS.length - 1);
    $("speed").textContent = `× ${SPEEDS[this.speed]}`;
  }
}
