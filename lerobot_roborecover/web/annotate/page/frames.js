// Frames of one episode in the page's memory: fetched as packs, kept as JPEG, decoded around where one looks.

const PARALLEL = 3;
const DECODED_AROUND = 16;

export class Frames {
  // episode: {id, steps}. session: {cameras, pack}. changed(loaded, all): packs so far.
  constructor(episode, session, changed = () => {}) {
    Object.assign(this, { id: episode.id, steps: episode.steps, cameras: session.cameras, size: session.pack, changed });
    this.count = Math.ceil(this.steps / this.size);
    this.packs = new Map(); // "camera/number" -> promise of an array of blobs
    this.blobs = new Map(); // "camera/number" -> array of blobs
    this.bitmaps = new Map(); // step -> promise of bitmaps by camera
    this.ready = new Map(); // step -> bitmaps by camera
    this.stopped = new AbortController();
  }

  // Fetches all packs, nearest to a step first. Errors are reported where a frame is shown.
  async load(around = 0) {
    const middle = Math.floor(around / this.size);
    const numbers = [...Array(this.count).keys()].sort((a, b) => Math.abs(a - middle) - Math.abs(b - middle));
    const todo = numbers.flatMap((number) => this.cameras.map((camera) => [camera, number]));
    const work = async () => {
      for (let next = todo.shift(); next && !this.stopped.signal.aborted; next = todo.shift())
        await this.#pack(...next).catch(() => {});
    };
    await Promise.all(Array.from({ length: PARALLEL }, work));
  }

  // Bitmaps of a step, by camera, if they are decoded.
  now(step) {
    return this.ready.get(step);
  }

  async at(step) {
    if (!this.bitmaps.has(step)) {
      const made = Promise.all(this.cameras.map(async (camera) => {
        const blobs = await this.#pack(camera, Math.floor(step / this.size));
        return createImageBitmap(blobs[step % this.size]);
      }));
      this.bitmaps.set(step, made);
      made.then((bitmaps) => this.ready.set(step, bitmaps), () => this.bitmaps.delete(step));
    }
    return this.bitmaps.get(step);
  }

  // Decodes around where one is, what is likely next first, one frame at a time: a key never waits for more than
  // the one in hand. Lets go of what lies far away.
  async look(step, direction) {
    const wish = (this.wish = {});
    for (const [known, bitmaps] of this.ready)
      if (Math.abs(known - step) > 3 * DECODED_AROUND) {
        this.ready.delete(known);
        this.bitmaps.delete(known);
        bitmaps.forEach((bitmap) => bitmap.close());
      }
    const order = [1, 10, 2, -1, 20, 3, -10, 4];
    for (let i = 5; i <= DECODED_AROUND; i++) order.push(i, 3 - i);
    for (const by of order) {
      const next = step + by * direction;
      if (next < 0 || next >= this.steps || this.ready.has(next)) continue;
      if (!this.cameras.every((camera) => this.blobs.has(`${camera}/${Math.floor(next / this.size)}`))) continue;
      await this.at(next).catch(() => {});
      if (this.wish !== wish || this.stopped.signal.aborted) return;
    }
  }

  stop() {
    this.stopped.abort();
  }

  #pack(camera, number) {
    const key = `${camera}/${number}`;
    if (!this.packs.has(key)) {
      const made = this.#fetch(camera, number);
      this.packs.set(key, made);
      made.then(
        (blobs) => { this.blobs.set(key, blobs); this.changed(this.blobs.size, this.count * this.cameras.length); },
        () => this.packs.delete(key),
      );
    }
    return this.packs.get(key);
  }

  async #fetch(camera, number) {
    const path = `api/episodes/${encodeURIComponent(this.id)}/frames/${encodeURIComponent(camera)}/${number}`;
    const answer = await fetch(path, { signal: this.stopped.signal });
    if (!answer.ok) throw new Error((await answer.json().catch(() => ({}))).error || `HTTP ${answer.status}`);
    const data = await answer.arrayBuffer();
    const view = new DataView(data);
    const count = view.getUint32(0, true);
    const blobs = [];
    for (let i = 0, at = 4 * (count + 1); i < count; i++) {
      const size = view.getUint32(4 * (i + 1), true);
      blobs.push(new Blob([new Uint8Array(data, at, size)], { type: "image/jpeg" }));
      at += size;
    }
    return blobs;
  }
}
