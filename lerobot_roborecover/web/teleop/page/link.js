// The websocket to the simulator: commands with answers, held inputs, status and pictures. Reconnects by itself.

const WAITS_MS = [200, 500, 1000, 2000];

export class Link {
  // status(message), pictures(step, [{name, jpeg}], scene), state(connected, why not): called as they come.
  constructor({ status, pictures, state }) {
    Object.assign(this, { status, pictures, state, asked: new Map(), next: 1, tries: 0, cameras: [], parts: [] });
    this.#connect();
  }

  get open() {
    return this.socket.readyState === WebSocket.OPEN;
  }

  // Resolves with the answer; rejects with an Error whose message says why not.
  ask(type, values = {}) {
    return new Promise((done, failed) => {
      if (!this.open) return failed(new Error("there is no connection to the simulator"));
      const id = this.next++;
      this.asked.set(id, { done, failed });
      this.socket.send(JSON.stringify({ ...values, type, id }));
    });
  }

  tell(type, values = {}) {
    if (this.open) this.socket.send(JSON.stringify({ ...values, type }));
  }

  #connect() {
    const socket = new WebSocket(`ws://${location.host}${location.pathname}socket`);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => { this.tries = 0; this.parts = []; this.state(true); };
    socket.onmessage = ({ data }) => this.#take(data);
    socket.onclose = ({ reason }) => {
      for (const { failed } of this.asked.values()) failed(new Error("the connection broke"));
      this.asked.clear();
      this.state(false, reason);
      if (!reason) this.#explain();
      setTimeout(() => this.#connect(), WAITS_MS[Math.min(this.tries++, WAITS_MS.length - 1)]);
    };
    this.socket = socket;
  }

  // A browser does not say why a websocket was refused; the page's own address does.
  async #explain() {
    const answer = await fetch(location.pathname, { method: "HEAD" }).catch(() => null);
    if (answer?.status === 403 && !this.open) {
      this.state(false, "This address is not valid any more: open the one that the terminal has printed.");
    }
  }

  #take(data) {
    if (data instanceof ArrayBuffer) {
      const camera = new DataView(data).getUint8(0);
      this.parts.push({ name: this.cameras[camera], jpeg: new Blob([data.slice(8)], { type: "image/jpeg" }) });
      return;
    }
    const message = JSON.parse(data);
    if (message.type === "status") this.status(message);
    else if (message.type === "cameras") this.cameras = message.names;
    else if (message.type === "shown") {
      const parts = this.parts;
      this.parts = [];
      // The next pictures are made once these are on the screen.
      this.pictures(message.step, parts, message.scene).finally(() => this.tell("seen"));
    } else if (message.type === "reply") {
      const asked = this.asked.get(message.id);
      this.asked.delete(message.id);
      if (message.ok) asked?.done(message);
      else asked?.failed(new Error(message.message));
    }
  }
}
