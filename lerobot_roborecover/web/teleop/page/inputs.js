// What keys and a gamepad hold, as six axes (forward, left, up, roll, pitch, yaw) from -1 to 1.

// By position on the keyboard, whatever the layout prints there.
const KEYS = {
  KeyW: [0, 1], KeyS: [0, -1], KeyA: [1, 1], KeyD: [1, -1], KeyE: [2, 1], KeyQ: [2, -1],
  Comma: [3, -1], Period: [3, 1], ArrowUp: [4, 1], ArrowDown: [4, -1], ArrowLeft: [5, 1], ArrowRight: [5, -1],
};
const WAIT = "KeyT";
const DEAD_ZONE = 0.15;
const AGAIN_MS = 150;
// Standard gamepad: the code of the key that each button stands for.
const BUTTONS = { 0: "Space", 1: "KeyZ", 2: "KeyM", 8: "Backspace", 9: "Enter" };

export const isMotion = (code) => code in KEYS || code === WAIT;

export class Inputs {
  // send(device, axes, wait): said on every change, and again while something is held. press(code): a button.
  constructor(send, press) {
    Object.assign(this, { send, press, held: new Set(), speed: 0.5, last: {}, sentAt: {}, down: new Set() });
    addEventListener("blur", () => this.release());
    setInterval(() => this.#tell(), 50);
  }

  key(code, down) {
    if (down) this.held.add(code);
    else this.held.delete(code);
    this.#tell();
  }

  release() {
    this.held.clear();
    this.#tell();
  }

  pad() {
    return [...(navigator.getGamepads?.() ?? [])].find((pad) => pad?.connected) ?? null;
  }

  #tell() {
    const axes = [0, 0, 0, 0, 0, 0];
    for (const code of this.held) if (code in KEYS) axes[KEYS[code][0]] += KEYS[code][1];
    this.#hold("keyboard", axes.map((v) => v * this.speed), this.held.has(WAIT));
    const pad = this.pad();
    if (pad) this.#hold("gamepad", this.#sticks(pad), Boolean(pad.buttons[3]?.pressed));
  }

  #sticks(pad) {
    for (const [button, code] of Object.entries(BUTTONS)) {
      const pressed = Boolean(pad.buttons[button]?.pressed);
      if (pressed && !this.down.has(button)) this.press(code);
      if (pressed) this.down.add(button);
      else this.down.delete(button);
    }
    const value = (v = 0) => (Math.abs(v) < DEAD_ZONE ? 0 : Math.sign(v) * (Math.abs(v) - DEAD_ZONE) / (1 - DEAD_ZONE));
    const button = (n) => pad.buttons[n]?.value ?? 0;
    const [x, y, turn, rise] = pad.axes.map(value);
    return [-y || 0, -x || 0, -rise || 0, button(5) - button(4), button(7) - button(6), -turn || 0]
      .map((v) => Math.max(-1, Math.min(1, v)) * this.speed);
  }

  #hold(device, axes, wait) {
    const said = JSON.stringify([axes, wait]);
    const active = wait || axes.some((v) => v !== 0);
    const due = active && performance.now() - (this.sentAt[device] ?? 0) > AGAIN_MS;
    if (said === (this.last[device] ?? JSON.stringify([[0, 0, 0, 0, 0, 0], false])) && !due) return;
    this.last[device] = said;
    this.sentAt[device] = performance.now();
    this.send(device, axes, wait);
  }
}
