/* Browsers refuse workers on file:// pages. There, run the search worker in a hidden frame instead. */
if (location.protocol === "file:") {
  self.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      this.frame = frame.contentWindow;
      addEventListener("message", (event) => {
        if (event.source !== this.frame) return;
        const copy = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(copy);
        if (this.onmessage) this.onmessage(copy);
      });
      const page = this.frame.document;
      page.open();
      page.write(
        "<script>postMessage = (data) => parent.dispatchEvent(new MessageEvent('message', { data, source: self }));" +
          "importScripts = (...urls) => Promise.all(urls.map((url) => new Promise((resolve, reject) => {" +
          "const script = document.createElement('script'); script.src = url; script.onload = resolve;" +
          "script.onerror = reject; document.body.appendChild(script); })));<\/script>" +
          '<body><script src="' + new URL(url, location.href) + '"><\/script></body>',
      );
      page.close();
      this.ready = new Promise((resolve) => this.frame.addEventListener("load", resolve, { once: true }));
    }

    postMessage(data) {
      this.ready.then(() => this.frame.dispatchEvent(new MessageEvent("message", { data: structuredClone(data) })));
    }

    terminate() {
      this.frame.frameElement.remove();
    }
  };
}
