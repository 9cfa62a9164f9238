// Search in pages opened from a folder: browsers start no worker there, so its script runs in a hidden frame.
// The theme looks for the name IFrameWorker.
class IFrameWorker extends EventTarget {
  constructor(url) {
    super();
    const frame = document.createElement("iframe");
    frame.hidden = true;
    document.body.append(frame);
    this.inside = frame.contentWindow;
    const load = (src) =>
      new Promise((done, failed) => {
        const script = this.inside.document.createElement("script");
        Object.assign(script, { src, onload: done, onerror: failed });
        this.inside.document.body.append(script);
      });
    this.inside.importScripts = (...urls) => urls.reduce((before, next) => before.then(() => load(next)), Promise.resolve());
    this.inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
    this.ready = load(new URL(url, document.baseURI).href);
  }

  postMessage(data) {
    this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
  }
}
if (location.protocol === "file:") {
  window.IFrameWorker = IFrameWorker;
  window.Worker = IFrameWorker;
}
